"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const find = (id) => document.getElementById(id);

// ---- the cloud: 16-bit places along the map's axes, turned about their middle ------------------------------
const VERTEX = `attribute vec3 place; attribute vec3 colour; uniform mat4 seen; uniform float size; varying vec3 shade;
void main() { gl_Position = seen * vec4(place, 1.0); gl_PointSize = clamp(size / gl_Position.w, 1.0, 24.0); shade = colour; }`;
const FRAGMENT = `precision mediump float; varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }`;

function decoded(text, count) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return { places: new Uint16Array(bytes.buffer, 0, 3 * count), colours: bytes.subarray(6 * count) };
}

function program(gl) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  return made;
}

function attribute(gl, shaders, name, values, type) {
  const place = gl.getAttribLocation(shaders, name);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, 3, type, true, 0, 0);
}

// Column-major matrix: places 0..1 → clip coordinates of a camera that turns about `target`.
function matrix(camera, aspect) {
  const [ct, st, cr, sr] = [Math.cos(camera.turn), Math.sin(camera.turn), Math.cos(camera.rise), Math.sin(camera.rise)];
  const right = [ct, st, 0], up = [-st * sr, ct * sr, cr], back = [st * cr, -ct * cr, sr];
  const offset = (axis) => -axis.reduce((sum, value, k) => sum + value * camera.target[k], 0);
  const near = camera.distance / 50, far = camera.distance + 4;
  const across = 1.7 / Math.max(aspect, 1), upwards = 1.7 * Math.min(aspect, 1);
  const rows = [[...right, offset(right)].map((value) => value * across), [...up, offset(up)].map((value) => value * upwards)];
  const depth = [...back, offset(back) - camera.distance];
  rows.push(depth.map((value, k) => value * (near + far) / (near - far) + (k === 3 ? 2 * near * far / (near - far) : 0)));
  rows.push(depth.map((value) => -value));
  return Float32Array.from({ length: 16 }, (_, k) => rows[k % 4][k >> 2]);
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
  const start = () => ({ turn: 0.35, rise: 0.75, distance: 2.4 * reach, target: data.cloud.middle });
  let camera = start(), waiting = false;
  const draw = () => {
    waiting = false;
    const sharp = window.devicePixelRatio || 1;
    [canvas.width, canvas.height] = [canvas.clientWidth * sharp, canvas.clientHeight * sharp].map(Math.round);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(gl.getUniformLocation(shaders, "seen"), false, matrix(camera, canvas.width / Math.max(canvas.height, 1)));
    gl.uniform1f(gl.getUniformLocation(shaders, "size"), spacing * Math.min(canvas.height, canvas.width) * 0.85);
    gl.drawArrays(gl.POINTS, 0, count);
  };
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
  const turn = (x, y) => { camera.turn += x; camera.rise = Math.min(Math.max(camera.rise + y, -1.57), 1.57); };
  const zoom = (factor) => { camera.distance = Math.min(Math.max(camera.distance * factor, 0.05 * reach), 20); };
  const move = (x, y) => {
    const [ct, st, cr, sr] = [Math.cos(camera.turn), Math.sin(camera.turn), Math.cos(camera.rise), Math.sin(camera.rise)];
    const right = [ct, st, 0], up = [-st * sr, ct * sr, cr];
    camera.target = camera.target.map((value, k) => value + camera.distance * (up[k] * y - right[k] * x));
  };
  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => { fingers.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); canvas.focus({ preventScroll: true }); });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const side = canvas.clientHeight, x = (event.clientX - last.clientX) / side, y = (event.clientY - last.clientY) / side;
    const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
    if (other) {
      const apart = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY) || 1;
      zoom(apart(last) / apart(event));
      move(x / 2, y / 2);
    } else if (event.shiftKey || event.buttons & 6) move(x, y); else turn(-4 * x, 3 * y);
    fingers.set(event.pointerId, event);
    redraw();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 120) / 600)); redraw(); }, { passive: false });
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  canvas.addEventListener("keydown", (event) => {
    const way = ways[event.key];
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (way) event.shiftKey ? move(-0.05 * way[0], -0.05 * way[1]) : turn(0.1 * way[0], 0.1 * way[1]);
    else if (event.key === "+" || event.key === "=") zoom(0.85);
    else if (event.key === "-") zoom(1 / 0.85);
    else if (event.key === "0" || event.key === "Home") camera = start();
    else if (event.key === "t" || event.key === "T") Object.assign(camera, { turn: 0, rise: 1.57 });
    else return;
    event.preventDefault();
    redraw();
  });
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
showCloud();
showMap();
document.querySelectorAll(".sortable").forEach(sortable);
showPairs();
offerCopy();
