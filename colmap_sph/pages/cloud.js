"use strict";
// ---- points in WebGL, seen by a camera that turns about a point ---------------------------------------------
const VERTEX = `attribute vec3 place; attribute vec3 colour; uniform mat4 seen; uniform float size; varying vec3 shade;
void main() { gl_Position = seen * vec4(place, 1.0); gl_PointSize = clamp(size / gl_Position.w, 1.0, 24.0); shade = colour; }`;
const FRAGMENT = `precision mediump float; varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }`;

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

// Right, up and back of a camera.
function axes(camera) {
  const [ct, st, cr, sr] = [Math.cos(camera.turn), Math.sin(camera.turn), Math.cos(camera.rise), Math.sin(camera.rise)];
  return [[ct, st, 0], [-st * sr, ct * sr, cr], [st * cr, -ct * cr, sr]];
}

// Column-major matrix: places → clip coordinates of a camera that turns about `target` and sees so far behind it.
function matrix(camera, aspect, behind) {
  const [right, up, back] = axes(camera);
  const offset = (axis) => -axis.reduce((sum, value, k) => sum + value * camera.target[k], 0);
  const near = camera.distance / 50, far = camera.distance + behind;
  const across = 1.7 / Math.max(aspect, 1), upwards = 1.7 * Math.min(aspect, 1);
  const rows = [[...right, offset(right)].map((value) => value * across), [...up, offset(up)].map((value) => value * upwards)];
  const depth = [...back, offset(back) - camera.distance];
  rows.push(depth.map((value, k) => value * (near + far) / (near - far) + (k === 3 ? 2 * near * far / (near - far) : 0)));
  rows.push(depth.map((value) => -value));
  return Float32Array.from({ length: 16 }, (_, k) => rows[k % 4][k >> 2]);
}

// Mouse, fingers and keys move a camera that is at `start` first, no nearer and no farther than it may be.
function controls(canvas, start, nearest, farthest, redraw) {
  const camera = { ...start };
  const turn = (x, y) => { camera.turn += x; camera.rise = Math.min(Math.max(camera.rise + y, -1.57), 1.57); };
  const zoom = (factor) => { camera.distance = Math.min(Math.max(camera.distance * factor, nearest), farthest); };
  const move = (x, y) => {
    const [right, up] = axes(camera);
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
    else if (event.key === "0" || event.key === "Home") Object.assign(camera, start);
    else if (event.key === "t" || event.key === "T") Object.assign(camera, { turn: 0, rise: 1.57 });
    else return;
    event.preventDefault();
    redraw();
  });
  return camera;
}
