// ---- the whole cloud, in as many points as the view can show -------------------------------------------------
// The cloud is a tree: the root has few points of all of it, each child more of a part, and the leaves the rest. What
// is drawn is the root, and below it what is in view and not as dense as the screen yet, the coarsest first.
// There are never more points than a few for each pixel of the screen, nor than can be drawn in a moment.
const MOST_DRAWN = 6e6, MOST_KEPT = 12e6, PER_PIXEL = 6, FEWEST = 2e5, AT_ONCE = 4, DENSE = 1, SIZE = 2;
const MOMENT = 3000, MOMENT_IN_MOTION = 60, REST = 250, REDRAWN_AFTER = 150; // milliseconds
const canvas = document.getElementById("view"), status = document.getElementById("status");

// Boxes of the nodes of each height, from those of the leaves: least x, y, z, largest x, y, z; null without points.
function boxes(index) {
  const heights = [index.leaves];
  while (heights.length <= index.height) {
    const below = heights.at(-1), made = [];
    for (let first = 0; first < below.length; first += index.fan) {
      const parts = below.slice(first, first + index.fan).filter((box) => box);
      made.push(parts.length ? parts[0].map((_, k) => (k < 3 ? Math.min : Math.max)(...parts.map((box) => box[k]))) : null);
    }
    heights.push(made);
  }
  return heights;
}

// How many boxes there are, on average, where each of them is: so much denser do points lie than those of one of them.
// Seen along the shortest side of all.
function layers(boxed, whole) {
  const [x, y] = [0, 1, 2].sort((a, b) => whole[b + 3] - whole[b] - (whole[a + 3] - whole[a]));
  const cells = 128, counts = new Uint32Array(cells * cells);
  const cell = (value, axis) => Math.min(Math.floor(cells * (value - whole[axis]) / (whole[axis + 3] - whole[axis] || 1)), cells - 1);
  const forCells = (box, what) => {
    for (let row = cell(box[y], y); row <= cell(box[y + 3], y); row += 1) {
      for (let column = cell(box[x], x); column <= cell(box[x + 3], x); column += 1) what(row * cells + column);
    }
  };
  for (const box of boxed) if (box) forCells(box, (place) => { counts[place] += 1; });
  return boxed.map((box) => {
    let sum = 0, number = 0;
    if (box) forCells(box, (place) => { sum += 1 / counts[place]; number += 1; });
    return number / (sum || 1);
  });
}

// All nodes, with about how many points they have, and how far these and those above lie apart.
function tree(index) {
  const heights = boxes(index);
  const whole = heights.at(-1)[0], deep = heights.map((each) => (whole ? layers(each, whole) : []));
  const above = (height) => index.shares.slice(height).reduce((sum, share) => sum + share, 0);
  const node = (height, number) => {
    const box = heights[height]?.[number];
    if (!box) return null;
    const width = index.fan ** height, leaves = Math.min(width, index.leaves.length - number * width);
    const sides = [0, 1, 2].map((k) => box[k + 3] - box[k]).sort((a, b) => b - a);
    const area = sides[0] * Math.max(sides[1], 1e-3 * sides[0]) || 1e-12;
    return { key: `${height}/${number}`, height, number, box, count: index.shares[height] * leaves,
      apart: Math.sqrt(area / (leaves * above(height) * Math.max(deep[height][number], 1))) };
  };
  const children = (parent) => (parent.height === 0 ? [] : Array.from({ length: index.fan }, (_, k) =>
    node(parent.height - 1, parent.number * index.fan + k)).filter((child) => child));
  return { root: node(index.height, 0), children };
}

function corners(box) {
  return Array.from({ length: 8 }, (_, k) => [box[k & 1 ? 3 : 0], box[k & 2 ? 4 : 1], box[k & 4 ? 5 : 2], 1]);
}

function isSeen(box, seen) {
  const clip = corners(box).map((corner) => [0, 1, 3].map((row) => corner.reduce((sum, value, k) => sum + value * seen[4 * k + row], 0)));
  return ![[0, 1], [0, -1], [1, 1], [1, -1]].some(([row, sign]) => clip.every((at) => sign * at[row] > at[2])) && clip.some((at) => at[2] > 0);
}

// Nodes to draw, the coarsest on the screen first, and of each those below it.
function wanted(cloud, camera, seen, pixels, most) {
  const [, , back] = axes(camera), eye = camera.target.map((value, k) => value + camera.distance * back[k]);
  const onScreen = (node) => {
    const beside = eye.map((value, k) => Math.max(node.box[k] - value, value - node.box[k + 3], 0));
    return node.apart * pixels / Math.max(Math.hypot(...beside), camera.distance / 50);
  };
  const chosen = [], waiting = cloud.root ? [[Infinity, cloud.root]] : [];
  let points = 0;
  while (waiting.length) {
    const [, node] = waiting.splice(waiting.reduce((best, each, k) => (each[0] > waiting[best][0] ? k : best), 0), 1)[0];
    if (points + node.count > most && chosen.length) break;
    points += node.count;
    chosen.push(node);
    node.below = [];
    if (onScreen(node) <= DENSE) continue;
    for (const child of cloud.children(node)) if (isSeen(child.box, seen)) { node.below.push(child); waiting.push([onScreen(child), child]); }
  }
  return chosen;
}

async function showWholeCloud() {
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) { status.textContent = "This browser draws no WebGL here."; return; }
  const index = await (await fetch("index.json")).json(), cloud = tree(index), shaders = program(gl);
  const places = ["place", "colour"].map((name) => gl.getAttribLocation(shaders, name));
  const [seenAt, sizeAt] = ["seen", "size"].map((name) => gl.getUniformLocation(shaders, name));
  gl.useProgram(shaders);
  places.forEach((place) => gl.enableVertexAttribArray(place));
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(0.063, 0.078, 0.102, 1);
  const kept = new Map(), coming = new Set();
  const onePixel = new Uint8Array(4);
  let chosen = [], waiting = false, now = 0, trouble = "", speed = 5e3, moved = -REST, rest = 0, due = 0, took = 0;

  const load = async (node) => {
    coming.add(node.key);
    try {
      const answer = await fetch(`node/${node.key}`);
      if (!answer.ok) throw new Error((await answer.text()).slice(0, 300));
      const data = await answer.arrayBuffer(), count = Math.floor(data.byteLength / 15);
      const made = [new Float32Array(data, 0, 3 * count), new Uint8Array(data, 12 * count, 3 * count)].map((values) => {
        const buffer = gl.createBuffer();
        gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
        gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
        return buffer;
      });
      kept.set(node.key, { count, buffers: made, used: now });
    } catch (error) {
      trouble = error instanceof TypeError ? "The program that serves the cloud has ended; start colmap_sph view again." : error.message;
    }
    coming.delete(node.key);
    fill();
    if (!due) due = setTimeout(() => { due = 0; redraw(); }, Math.max(REDRAWN_AFTER, 2 * took));
  };
  const forget = () => {
    let points = [...kept.values()].reduce((sum, each) => sum + each.count, 0);
    for (const [key, each] of [...kept].sort((a, b) => a[1].used - b[1].used)) {
      if (points <= MOST_KEPT || each.used === now) break;
      each.buffers.forEach((buffer) => gl.deleteBuffer(buffer));
      kept.delete(key);
      points -= each.count;
    }
  };
  // Where all below is there, its points lie as near to each other as theirs.
  const spacings = () => {
    const apart = new Map();
    for (const node of [...chosen].reverse()) {
      const below = node.below.map((child) => (kept.has(child.key) ? apart.get(child.key) : undefined));
      apart.set(node.key, below.length && !below.includes(undefined) ? Math.max(...below) : node.apart);
    }
    return apart;
  };
  // Have more nodes come, those first that are wanted first; returns those that are not there.
  const fill = () => {
    const missing = trouble ? [] : chosen.filter((node) => !kept.has(node.key));
    for (const node of missing) if (coming.size < AT_ONCE && !coming.has(node.key)) load(node);
    return missing;
  };
  const draw = () => {
    waiting = false;
    now += 1;
    const sharp = window.devicePixelRatio || 1;
    const size = [canvas.clientWidth * sharp, canvas.clientHeight * sharp].map(Math.round);
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    const pixels = 0.85 * Math.min(canvas.height, canvas.width), seen = matrix(camera, canvas.width / Math.max(canvas.height, 1), index.behind);
    const began = performance.now(), moment = began - moved < REST ? MOMENT_IN_MOTION : MOMENT;
    const most = Math.min(MOST_DRAWN, PER_PIXEL * canvas.width * canvas.height, Math.max(speed * moment, FEWEST));
    chosen = wanted(cloud, camera, seen, pixels, most);
    const apart = spacings();
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(seenAt, false, seen);
    let drawn = 0;
    for (const node of chosen) {
      const each = kept.get(node.key);
      if (!each) continue;
      each.used = now;
      gl.uniform1f(sizeAt, SIZE * apart.get(node.key) * pixels);
      [gl.FLOAT, gl.UNSIGNED_BYTE].forEach((kind, k) => {
        gl.bindBuffer(gl.ARRAY_BUFFER, each.buffers[k]);
        gl.vertexAttribPointer(places[k], 3, kind, true, 0, 0);
      });
      gl.drawArrays(gl.POINTS, 0, each.count);
      drawn += each.count;
    }
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, onePixel); // waits for the drawing
    took = performance.now() - began;
    if (drawn > FEWEST / 4) speed += 0.3 * (drawn / Math.max(took, 1) - speed);
    forget();
    const missing = fill();
    status.textContent = trouble || `${drawn.toLocaleString("en")} of ${index.count.toLocaleString("en")} points drawn${missing.length ? " …" : ""}`;
    canvas.dataset.missing = missing.length + (moment === MOMENT ? 0 : 1);
    canvas.dataset.drawn = drawn;
  };
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
  const moving = () => { moved = performance.now(); clearTimeout(rest); rest = setTimeout(redraw, REST); redraw(); };
  const camera = controls(canvas, { turn: 0.35, rise: 0.75, distance: 2.4, target: [0, 0, 0] }, 0.001, 50, moving);
  canvas.addEventListener("webglcontextlost", () => { trouble = "The graphics card has no memory left; reload the page."; });
  new ResizeObserver(redraw).observe(canvas);
}

showWholeCloud().catch((error) => { status.textContent = String(error); });
