const data = JSON.parse(document.getElementById("data").textContent);
const find = (id) => document.getElementById(id);

// ---- the cloud: 16-bit places along the map's axes, turned about their middle ------------------------------
function decoded(text, count) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return { places: new Uint16Array(bytes.buffer, 0, 3 * count), colours: bytes.subarray(6 * count) };
}

function showCloud() {
  const canvas = find("view");
  if (!canvas || !data.cloud) return;
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) { canvas.hidden = true; find("view-lack").hidden = false; return; }
  const count = data.cloud.count, points = decoded(data.cloud.text, count), shaders = program(gl);
  gl.useProgram(shaders);
  attribute(gl, shaders, "place", points.places, gl.UNSIGNED_SHORT);
  attribute(gl, shaders, "colour", points.colours, gl.UNSIGNED_BYTE);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(0.063, 0.078, 0.102, 1);
  const reach = data.cloud.reach, spacing = 2.4 * reach / Math.sqrt(count);
  let waiting = false;
  const draw = () => {
    waiting = false;
    const sharp = window.devicePixelRatio || 1;
    [canvas.width, canvas.height] = [canvas.clientWidth * sharp, canvas.clientHeight * sharp].map(Math.round);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(gl.getUniformLocation(shaders, "seen"), false, matrix(camera, canvas.width / Math.max(canvas.height, 1), 4));
    gl.uniform1f(gl.getUniformLocation(shaders, "size"), spacing * Math.min(canvas.height, canvas.width) * 0.85);
    gl.drawArrays(gl.POINTS, 0, count);
    canvas.dataset.drawn = count;
  };
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
  const start = { turn: 0.35, rise: 0.75, distance: 2.4 * reach, target: data.cloud.middle };
  const camera = controls(canvas, start, 0.05 * reach, 20, redraw);
  canvas.addEventListener("webglcontextlost", () => { find("view-lack").hidden = false; });
  new ResizeObserver(redraw).observe(canvas);
}

// ---- the map ------------------------------------------------------------------------------------------------
function showMap() {
  const layers = document.querySelectorAll(".layer"), texts = document.querySelectorAll(".layer-text");
  find("layers").addEventListener("change", (event) => {
    if (event.target.name === "layer") {
      const chosen = Number(event.target.value);
      [layers, texts].forEach((each) => each.forEach((layer, k) => layer.classList.toggle("off", k !== chosen)));
      layers[0].classList.toggle("faint", "onColours" in layers[chosen].dataset);
    } else find(event.target.id.replace("with-", "")).classList.toggle("off", !event.target.checked);
  });
  const choose = (event) => {
    const camera = event.target.closest("#cameras a"), number = camera ? camera.dataset.image : null;
    document.querySelectorAll("#map .chosen").forEach((each) => each.classList.remove("chosen"));
    if (number) document.querySelectorAll(`#map [data-image="${number}"]`).forEach((each) => each.classList.add("chosen"));
  };
  find("cameras").addEventListener("pointerover", choose);
  find("cameras").addEventListener("pointerout", choose);
}

// ---- tables -------------------------------------------------------------------------------------------------
function valueOf(row, column) {
  const cell = row.cells[column];
  if (column === 0 || cell.tagName === "TH") return cell.textContent;
  return "value" in cell.dataset ? Number(cell.dataset.value) : cell.textContent;
}

const inOrder = new Intl.Collator(undefined, { numeric: true });
// What is not known comes last, whichever way a table is sorted.
function compared(a, b, sign) {
  if (a === "" || b === "") return (a === "") - (b === "");
  if (typeof a === "number" && typeof b === "number") return sign * (a - b);
  return sign * inOrder.compare(a, b);
}

function sortable(table) {
  table.querySelectorAll("thead th").forEach((heading, column) => heading.querySelector("button").addEventListener("click", () => {
    const isUp = heading.getAttribute("aria-sort") === "ascending";
    table.querySelectorAll("thead th").forEach((each) => each.removeAttribute("aria-sort"));
    heading.setAttribute("aria-sort", isUp ? "descending" : "ascending");
    const rows = [...table.tBodies[0].rows].map((row) => [valueOf(row, column), row]);
    rows.sort((a, b) => compared(a[0], b[0], isUp ? -1 : 1));
    table.tBodies[0].append(...rows.map((each) => each[1]));
  }));
}

const MOST_PAIRS = 2000;
function showPairs() {
  const list = find("pair-list");
  if (!list) return;
  const body = find("pair-table").tBodies[0], more = find("pair-more");
  const fill = () => {
    const word = find("pair-filter").value.toLowerCase();
    const wanted = data.pairs.filter(([left, right]) => [left, right].some((k) => data.names[k].toLowerCase().includes(word)));
    body.replaceChildren(...wanted.slice(0, MOST_PAIRS).map(([left, right, angle, rows]) => {
      const row = document.createElement("tr");
      for (const text of [data.names[left], data.names[right]]) row.insertCell().textContent = text;
      for (const value of [angle, rows]) {
        const cell = row.insertCell();
        if (value !== null) { cell.dataset.value = value; cell.textContent = value; }
      }
      return row;
    }));
    more.hidden = wanted.length <= MOST_PAIRS;
    more.textContent = `The first ${MOST_PAIRS} of ${wanted.length}; give part of a name.`;
    find("pair-table").querySelectorAll("thead th").forEach((each) => each.removeAttribute("aria-sort"));
  };
  list.addEventListener("toggle", () => { if (list.open && !body.rows.length) fill(); });
  find("pair-filter").addEventListener("input", fill);
}

function offerCopy() {
  const button = find("copy");
  if (!button || !navigator.clipboard) return;
  button.hidden = false;
  button.addEventListener("click", () => navigator.clipboard.writeText(find("command").textContent).then(() => { button.textContent = "Copied"; }));
}

window.addEventListener("beforeprint", () => document.querySelectorAll("img[loading]").forEach((image) => { image.loading = "eager"; }));
showMap();
document.querySelectorAll(".sortable").forEach(sortable);
showPairs();
offerCopy();
// Graphics without a card take their time: all else is there before.
requestAnimationFrame(() => setTimeout(showCloud));
