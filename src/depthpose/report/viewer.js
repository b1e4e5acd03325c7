// A 3D view of points and lines in plain WebGL: showScene(element, scene).
//
// A scene is {caption, note, layers: [{name, kind, shown, count, places, low, step, colors}]}: kind
// is "points" or "lines", places are base64 of little-endian 16-bit steps from low (three a point,
// six a line), colors of 8-bit RGB. The frame is a camera's: x right, y down, z forward, in metres.
// One WebGL context draws all views of a page (browsers allow few), and each is copied to a canvas
// that prints. Where an element gets another scene, its former one is let go.
const showScene = (() => {
  const POINTS = `
    attribute vec3 place; attribute vec3 color; uniform mat4 view; uniform float size;
    uniform vec2 screen; varying vec3 ink;
    void main() {
      gl_Position = view * vec4(place, 1.0);
      gl_PointSize = clamp(size / gl_Position.w, screen.x, screen.y);
      ink = color;
    }`;
  // A line is two triangles as wide as `size` pixels; an end behind the eye is cut off first.
  const LINES = `
    attribute vec3 place; attribute vec3 other; attribute float side; attribute vec3 color;
    uniform mat4 view; uniform float size; uniform vec2 screen; varying vec3 ink;
    vec4 cut(vec4 a, vec4 b) {
      float near = 0.001;
      return a.w < near && b.w > near ? mix(a, b, (near - a.w) / (b.w - a.w)) : a;
    }
    void main() {
      vec4 a = view * vec4(place, 1.0), b = view * vec4(other, 1.0);
      vec4 p = cut(a, b), q = cut(b, a);
      vec2 way = (q.xy / q.w - p.xy / p.w) * screen;
      vec2 across = length(way) > 0.0 ? normalize(vec2(-way.y, way.x)) : vec2(0.0);
      gl_Position = p + vec4(side * size * across / screen * p.w, 0.0, 0.0);
      ink = color;
    }`;
  const FRAGMENT = `
    precision mediump float; varying vec3 ink; uniform float round;
    void main() {
      if (round > 0.0 && length(gl_PointCoord - 0.5) > 0.5) discard;
      gl_FragColor = vec4(ink, 1.0);
    }`;
  const HINT = "drag turns, shift-drag moves, wheel zooms, double click resets";
  const LACKING = "Your browser shows no WebGL, so this 3D view is empty; " +
    "the same points are in the PLY file beside it.";

  const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
  const unit = a => scaled(a, 1 / (Math.hypot(...a) || 1));
  const made = (name, facts) => Object.assign(document.createElement(name), facts);
  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

  function decoded(text, Kind) {
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return new Kind(bytes.buffer);
  }

  function program(gl, vertex, names) {
    const result = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(result, shader);
    }
    names.forEach((name, i) => gl.bindAttribLocation(result, i, name));
    gl.linkProgram(result);
    if (!gl.getProgramParameter(result, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(result));
    const at = name => gl.getUniformLocation(result, name);
    return { program: result, view: at("view"), size: at("size"), screen: at("screen"), round: at("round") };
  }

  let shared;  // undefined: not tried; null: no WebGL
  function context() {
    if (shared !== undefined) return shared;
    const canvas = made("canvas"), gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
    if (!gl) return shared = null;
    const build = () => {
      shared = { gl, canvas, lost: false,
        points: program(gl, POINTS, ["place", "color"]),
        lines: program(gl, LINES, ["place", "other", "side", "color"]) };
    };
    canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); shared.lost = true; });
    canvas.addEventListener("webglcontextrestored", () => {
      build();
      for (const view of views) { view.upload(); view.ask(); }
    });
    build();
    return shared;
  }
  const views = new Set();

  function buffer(gl, values) {
    const result = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, result);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    return result;
  }

  // Six corners a line, each with the other end and the side that it lies on.
  function corners(layer) {
    const ORDER = [[0, 1], [0, -1], [1, 1], [1, 1], [0, -1], [1, -1]];
    const place = new Float32Array(18 * layer.count), other = new Float32Array(18 * layer.count);
    const side = new Float32Array(6 * layer.count), color = new Uint8Array(18 * layer.count);
    for (let i = 0; i < layer.count; i++) ORDER.forEach(([end, s], k) => {
      const at = 6 * i + k, from = 6 * i + 3 * end, to = 6 * i + 3 * (1 - end);
      place.set(layer.places.subarray(from, from + 3), 3 * at);
      other.set(layer.places.subarray(to, to + 3), 3 * at);
      side[at] = end ? -s : s;  // seen from the other end, left is right
      color.set(layer.colors.subarray(3 * i, 3 * i + 3), 3 * at);
    });
    return { place, other, side, color };
  }

  // The one colour of some layers; nothing where there are more.
  function onlyColor(layers) {
    const first = layers[0].colors.subarray(0, 3);
    const isAlike = ({ colors }) => colors.every((value, i) => value === first[i % 3]);
    return first.length && layers.every(isAlike) ? first.join(", ") : undefined;
  }

  // The middle of points, and the size of the box that holds nearly all: strays do not set the view.
  function extent(layers) {
    const axes = [[], [], []];
    for (const { places, kind } of layers) {
      const step = 3 * Math.max(1, Math.floor(places.length / 30000));
      for (let i = 0; i + 2 < places.length; i += step) for (const k of [0, 1, 2]) axes[k].push(places[i + k]);
    }
    const sorted = axes.map(values => Float32Array.from(values).sort());
    const at = share => sorted.map(values => values[Math.round(share * (values.length - 1))] || 0);
    return { middle: at(0.5), size: Math.max(Math.hypot(...minus(at(0.98), at(0.02))), 1e-6) };
  }

  // Column-major: perspective times the look from `eye` along `forward`.
  function viewMatrix(eye, forward, aspect, size) {
    const right = unit(cross(forward, [0, -1, 0])), up = cross(right, forward);
    const f = 1 / Math.tan(0.4), fx = f / Math.max(aspect, 1), fy = fx * aspect;
    const near = size / 500, far = 60 * size, a = (far + near) / (far - near), b = -2 * far * near / (far - near);
    const row = (axis, s) => [...scaled(axis, s), -s * dot(axis, eye)];
    const rows = [row(right, fx), row(up, fy), row(forward, a), row(forward, 1)];
    rows[2][3] += b;
    return Float32Array.from([0, 1, 2, 3].flatMap(c => rows.map(r => r[c])));
  }

  return function showScene(element, scene) {
    element.stopScene?.();
    element.replaceChildren();
    element.classList.add("scene");
    if (!context()) return element.append(made("p", { className: "lacking", textContent: LACKING }));
    const layers = scene.layers.map(layer => ({ ...layer,
      places: Float32Array.from(decoded(layer.places, Uint16Array), (n, i) => layer.low[i % 3] + n * layer.step[i % 3]),
      colors: decoded(layer.colors, Uint8Array) }));
    const canvas = made("canvas", { tabIndex: 0, role: "img" }), flat = canvas.getContext("2d");
    canvas.ariaLabel = `3D view: ${scene.caption}. Arrow keys turn it, plus and minus zoom, 0 resets.`;
    const keys = made("div", { className: "keys" });
    element.append(canvas, keys);
    for (const layer of layers) layer.size = extent([layer]).size;
    const clouds = layers.filter(layer => layer.shown && layer.kind === "points");
    const { middle, size } = extent(clouds.length ? clouds : layers);
    // From where the camera stood, but no farther off than all is seen.
    const reach = 1.3 * Math.hypot(...middle);
    const start = { yaw: 0.22, pitch: 0.18, target: middle,
      distance: Math.min(reach > 0.1 * size ? reach : size, 1.25 * size) };
    let eye = { ...start }, waiting = false;

    const ask = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
    const forward = () => [Math.sin(eye.yaw) * Math.cos(eye.pitch), Math.sin(eye.pitch), Math.cos(eye.yaw) * Math.cos(eye.pitch)];

    function upload() {
      const gl = context().gl;
      for (const layer of layers) layer.buffers = layer.kind === "points"
        ? { place: buffer(gl, layer.places), color: buffer(gl, layer.colors) }
        : Object.fromEntries(Object.entries(corners(layer)).map(([name, v]) => [name, buffer(gl, v)]));
    }

    function bind(gl, at, from, count, kind, normalised) {
      gl.bindBuffer(gl.ARRAY_BUFFER, from);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, count, kind, normalised, 0, 0);
    }

    function draw() {
      waiting = false;
      const { gl, canvas: board, points, lines, lost } = context();
      const dpr = window.devicePixelRatio || 1;
      const width = Math.round(canvas.clientWidth * dpr), height = Math.round(canvas.clientHeight * dpr);
      if (lost || !width || !height) return;
      for (const c of [board, canvas]) if (c.width !== width || c.height !== height) { c.width = width; c.height = height; }
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      const view = viewMatrix(minus(eye.target, scaled(forward(), eye.distance)), forward(), width / height, eye.distance);
      for (const layer of layers) if (layer.shown && layer.count) {
        const isPoints = layer.kind === "points", use = isPoints ? points : lines, from = layer.buffers;
        gl.useProgram(use.program);
        gl.uniformMatrix4fv(use.view, false, view);
        gl.uniform1f(use.round, isPoints ? 1 : 0);
        bind(gl, 0, from.place, 3, gl.FLOAT, false);
        if (isPoints) {
          // A point fills the gaps between as many on a square of the layer's size; it grows when
          // zoomed into, and near ones cover no more than their share of the view.
          const share = clamp(1.3 * Math.sqrt(width * height / layer.count), 2 * dpr, 6 * dpr);
          gl.uniform1f(use.size, 0.7 * layer.size * height / Math.sqrt(layer.count));
          gl.uniform2f(use.screen, 1.3 * dpr, share * Math.max(1, start.distance / eye.distance));
          bind(gl, 1, from.color, 3, gl.UNSIGNED_BYTE, true);
        } else {
          gl.uniform1f(use.size, 1.6 * dpr);
          gl.uniform2f(use.screen, width, height);
          bind(gl, 1, from.other, 3, gl.FLOAT, false);
          bind(gl, 2, from.side, 1, gl.FLOAT, false);
          bind(gl, 3, from.color, 3, gl.UNSIGNED_BYTE, true);
        }
        gl.drawArrays(isPoints ? gl.POINTS : gl.TRIANGLES, 0, isPoints ? layer.count : 6 * layer.count);
        for (const at of [0, 1, 2, 3]) gl.disableVertexAttribArray(at);
      }
      flat.clearRect(0, 0, width, height);
      flat.drawImage(board, 0, 0);
    }

    const turn = (dx, dy) => { eye.yaw += dx; eye.pitch = clamp(eye.pitch + dy, -1.5, 1.5); ask(); };
    const zoom = factor => { eye.distance = clamp(eye.distance * factor, 0.01 * size, 20 * size); ask(); };
    const pan = (dx, dy) => {
      const right = unit(cross(forward(), [0, -1, 0])), up = cross(right, forward());
      const step = eye.distance / canvas.clientHeight;
      eye.target = eye.target.map((x, k) => x - (dx * right[k] - dy * up[k]) * step);
      ask();
    };
    const reset = () => { eye = { ...start }; ask(); };

    // One pointer turns (or pans, with shift or another button); two pan and pinch.
    const held = new Map();
    const spread = () => { const [a, b] = [...held.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
    canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, { x: e.clientX, y: e.clientY }); });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, e => held.delete(e.pointerId));
    canvas.addEventListener("pointermove", e => {
      const last = held.get(e.pointerId);
      if (!last) return;
      const before = held.size === 2 ? spread() : 0, dx = e.clientX - last.x, dy = e.clientY - last.y;
      held.set(e.pointerId, { x: e.clientX, y: e.clientY });
      if (held.size === 2) { pan(dx / 2, dy / 2); zoom(before / Math.max(spread(), 1)); }
      else if (e.shiftKey || e.buttons & 6) pan(dx, dy);
      else turn(dx * 0.006, dy * 0.006);
    });
    canvas.addEventListener("wheel", e => { e.preventDefault(); zoom(Math.exp(clamp(e.deltaY, -100, 100) * 0.0015)); }, { passive: false });
    canvas.addEventListener("contextmenu", e => e.preventDefault());
    canvas.addEventListener("dblclick", reset);
    const PRESSED = { ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1),
      ArrowDown: () => turn(0, 0.1), "+": () => zoom(0.85), "-": () => zoom(1.18), 0: reset };
    canvas.addEventListener("keydown", e => { if (PRESSED[e.key]) { e.preventDefault(); PRESSED[e.key](); } });

    const names = new Set(layers.map(layer => layer.name));
    if (names.size > 1) for (const name of names) {
      const same = layers.filter(layer => layer.name === name);
      const label = made("label"), box = made("input", { type: "checkbox", checked: same[0].shown });
      box.addEventListener("change", () => { for (const layer of same) layer.shown = box.checked; ask(); });
      label.append(box, " ");
      const ink = onlyColor(same);
      if (ink) label.append(made("span", { className: "swatch", style: `background: rgb(${ink})` }), " ");
      label.append(name);
      keys.append(label);
    }
    keys.append(made("span", { className: "hint", textContent: HINT }));
    upload();
    const view = { upload, ask }, sizes = new ResizeObserver(ask);
    views.add(view);
    sizes.observe(canvas);
    element.stopScene = () => {
      sizes.disconnect();
      views.delete(view);
      for (const layer of layers) for (const old of Object.values(layer.buffers)) context().gl.deleteBuffer(old);
      layers.length = 0;
    };
    draw();
  };
})();
