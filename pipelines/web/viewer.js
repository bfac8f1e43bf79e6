// Show a scene in 3D with WebGL2: ground, boxes and ellipsoids with shadows. Scene frame: x ahead, y left, z up (m).
//
//   const viewer = new Viewer(canvas); viewer.show(scene);   // pipelines/io/web_export.py exports the scene.
//   viewer.onpick = index => ...                              // Index of the clicked primitive, -1 for none.
//
// Dragging rotates the view. Dragging with the right button or with two fingers moves the view. The wheel zooms.

const CUBE = cube(), BALL = ball(24, 16), COARSE_BALL = ball(10, 6);
const SUN = normalised([0.45, -0.5, 0.78]);
const SHADOW_PX = 2048;

const VERTEX = `#version 300 es
layout(location=0) in vec3 corner; layout(location=1) in vec3 outward;
layout(location=2) in vec4 col0; layout(location=3) in vec4 col1; layout(location=4) in vec4 col2; layout(location=5) in vec4 col3;
layout(location=6) in vec4 paint; layout(location=7) in vec2 place;
uniform mat4 seen, lit; uniform highp int kind;
out vec3 normal, point, local; out vec4 color; out vec4 shade; out vec2 uv;
void main() {
  vec3 p; local = corner;
  if (kind == 2) { p = corner; normal = outward; color = vec4(1.); uv = place; }
  else {
    mat3 m = mat3(col0.xyz, col1.xyz, col2.xyz);
    p = m * corner + col3.xyz;
    vec3 squares = vec3(dot(m[0], m[0]), dot(m[1], m[1]), dot(m[2], m[2]));
    normal = m * ((kind == 1 ? corner : outward) / squares);
    color = paint; uv = vec2(0.);
  }
  point = p; shade = lit * vec4(p, 1.); gl_Position = seen * vec4(p, 1.);
}`;

const FRAGMENT = `#version 300 es
precision highp float; precision highp sampler2DShadow;
in vec3 normal, point, local; in vec4 color, shade; in vec2 uv;
uniform sampler2D ground; uniform sampler2DShadow shadow; uniform vec3 sun, eye; uniform highp int kind;
out vec4 result;
void main() {
  vec4 base = color;
  if (kind == 2) { base = texture(ground, uv); if (base.a < .5) discard; base.rgb = pow(base.rgb, vec3(2.2)); }
  vec3 n = normalize(normal), s = shade.xyz / shade.w * .5 + .5;
  float sunlit = 0., step = 1. / float(${SHADOW_PX});
  for (int i = -1; i <= 1; i++) for (int j = -1; j <= 1; j++)
    sunlit += texture(shadow, vec3(s.xy + step * 1.5 * vec2(i, j), s.z - .0012)) / 9.;
  if (any(lessThan(s, vec3(0.))) || any(greaterThan(s, vec3(1.)))) sunlit = 1.;
  float light = .62 * max(dot(n, sun), 0.) / sun.z * sunlit + .38 * (.68 + .32 * n.z);
  if (kind == 0) {  // Draw a thin dark line along the edges of a box.
    vec3 d = (.5 - abs(local)) / max(fwidth(local), vec3(1e-6));  // The distance along the normal of the face is about 0.
    float a = min(d.x, d.y), b = max(d.x, d.y), second = d.z < a ? a : min(b, d.z);
    light *= mix(.6, 1., smoothstep(.4, 1.4, second));
  }
  vec3 c = base.rgb * light;
  if (color.a > 1.5 && kind != 2) c = mix(c, vec3(1., .55, 0.), .55);
  result = vec4(pow(c, vec3(1. / 2.2)), 1.);
}`;

const DEPTH = `#version 300 es
precision highp float; in vec2 uv; uniform sampler2D ground; uniform highp int kind;
void main() { if (kind == 2 && texture(ground, uv).a < .5) discard; }`;

export class Viewer {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = (this.gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true }));
    if (!gl) throw new Error("this browser has no WebGL2");
    this.program = linked(gl, VERTEX, FRAGMENT);
    this.depth = linked(gl, VERTEX, DEPTH);
    this.parts = [];
    this.focus = { middle: [32, 0, 0], reach: 50 };  // Area with shadows (m).
    this.onmove = () => {};
    this.camera = { target: [32, 0, 0], distance: 75, azimuth: Math.PI, elevation: 0.75 };
    this.shadow = shadowMap(gl);
    this.chosen = -1;
    this.onpick = () => {};
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  // Replace the scene. The camera changes only if the grid changes.
  async show(scene) {
    const grid = scene.grid, key = JSON.stringify(grid);
    if (key !== this.grid) {
      this.grid = key;
      const length = grid.rows * grid.resolution_m, width = grid.cols * grid.resolution_m;
      this.camera.target = [grid.front_m - length / 2, grid.left_m - width / 2, 0];
      this.camera.distance = 1.15 * Math.max(length, width);
    }
    this.scene = scene;
    const made = await this.add(scene);
    this.remove(this.parts.filter((part) => !made.includes(part)));
    this.focus = focus(grid);
    this.heights = scene.primitives.map((p) => p.center_m[2]);
    this.moving = null;
    this.draw();
  }

  // Show boxes that move: the first call adds them, further calls with as many boxes move them, null removes them.
  showMoving(primitives) {
    if (!primitives || this.moving?.count !== primitives.length) {
      if (this.moving) this.remove([this.moving.part]);
      this.moving = null;
      if (primitives?.length) {
        const part = instances(this.gl, 0, primitives.map((p, i) => i), primitives);
        this.moving = { count: primitives.length, part: { kind: 0, draw: part.draw, free: part.free }, placeAll: part.placeAll };
        this.parts = [...this.parts, this.moving.part];
      }
    } else this.moving?.placeAll(primitives);
    this.draw();
  }

  // Add a scene to those that are shown, and return its parts. Coarse ellipsoids have fewer faces.
  async add(scene, coarse = false) {
    const gl = this.gl, texture = await picture(gl, scene.ground.picture), made = [terrain(gl, scene.ground, scene.grid, texture)];
    for (const kind of [0, 1]) {
      const numbers = scene.primitives.map((p, i) => i).filter((i) => scene.primitives[i].ellipsoid === (kind === 1));
      if (numbers.length) made.push(instances(gl, kind, numbers, scene.primitives, coarse));
    }
    this.parts = [...this.parts, ...made];
    return made;
  }

  // Remove the parts of a scene.
  remove(parts) {
    this.parts = this.parts.filter((part) => !parts.includes(part));
    for (const part of parts) part.free();
  }

  choose(index) { this.chosen = index; for (const part of this.parts) part.mark?.(index); this.draw(); }

  // Draw one primitive at another place as a preview.
  move(index, primitive) { for (const part of this.parts) part.place?.(index, primitive); this.draw(); }

  matrices() {
    const c = this.camera, e = [Math.cos(c.elevation) * Math.cos(c.azimuth), Math.cos(c.elevation) * Math.sin(c.azimuth), Math.sin(c.elevation)];
    const eye = c.target.map((t, i) => t + c.distance * e[i]);
    const aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
    const seen = times(perspective(0.7, aspect, c.distance / 50, c.distance * 12), looking(eye, c.target));
    return { eye, seen };
  }

  draw() {
    if (!this.waiting) { this.waiting = true; requestAnimationFrame(() => { this.waiting = false; this.paint(); }); }
  }

  paint() {
    const { gl, canvas } = this, ratio = Math.min(2, window.devicePixelRatio || 1);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    this.onmove();
    const { eye, seen } = this.matrices(), { middle, reach } = this.focus;
    const lit = times(parallel(reach), looking(middle.map((m, i) => m + reach * SUN[i]), middle));
    gl.enable(gl.DEPTH_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadow.frame);
    gl.viewport(0, 0, SHADOW_PX, SHADOW_PX); gl.clear(gl.DEPTH_BUFFER_BIT);
    this.pass(this.depth, { seen: lit, lit });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height); gl.clearColor(0.953, 0.961, 0.973, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.activeTexture(gl.TEXTURE1); gl.bindTexture(gl.TEXTURE_2D, this.shadow.texture);
    this.pass(this.program, { seen, lit, sun: SUN, eye, shadow: 1 });
  }

  pass(program, values) {
    const gl = this.gl;
    gl.useProgram(program);
    const at = (name) => gl.getUniformLocation(program, name);
    for (const name of ["seen", "lit"]) gl.uniformMatrix4fv(at(name), false, values[name]);
    for (const name of ["sun", "eye"]) if (values[name] && at(name)) gl.uniform3fv(at(name), values[name]);
    if (values.shadow && at("shadow")) gl.uniform1i(at("shadow"), values.shadow);
    gl.uniform1i(at("ground"), 0);
    for (const part of this.parts) { gl.uniform1i(at("kind"), part.kind); part.draw(); }
  }

  // Return the start and the direction (scene frame) of the ray through a point of the canvas (CSS pixels).
  ray(x, y) {
    const { eye, seen } = this.matrices(), back = inverse(seen);
    const clip = [(2 * x) / this.canvas.clientWidth - 1, 1 - (2 * y) / this.canvas.clientHeight, 1, 1];
    const far = apply(back, clip);
    return { from: eye, way: normalised([0, 1, 2].map((i) => far[i] / far[3] - eye[i])) };
  }

  // Return the index of the first primitive under a point of the canvas, -1 if there is none.
  pick(x, y) {
    const { from, way } = this.ray(x, y);
    let best = Infinity, found = -1;
    this.scene?.primitives.forEach((p, index) => {
      const t = meets(p, from, way);
      if (t > 0 && t < best) { best = t; found = index; }
    });
    return found;
  }

  // Return the point where the ray through a point of the canvas intersects a horizontal plane.
  onPlane(x, y, z) {
    const { from, way } = this.ray(x, y), t = (z - from[2]) / way[2];
    return t > 0 ? from.map((f, i) => f + t * way[i]) : null;
  }

  listen() {
    const canvas = this.canvas, down = new Map();
    let moved = 0, spread = 0;
    canvas.style.touchAction = "none";
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => { down.set(event.pointerId, event); moved = 0; spread = 0; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointermove", (event) => {
      const before = down.get(event.pointerId);
      if (!before || this.busy) return;
      const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY, c = this.camera;
      down.set(event.pointerId, event); moved += Math.abs(dx) + Math.abs(dy);
      const pan = before.buttons & 2 || event.shiftKey || down.size === 2;
      if (down.size === 2) {
        const [a, b] = [...down.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (spread) c.distance *= spread / now;
        spread = now;
      }
      if (pan) {
        const scale = (c.distance * 0.73) / canvas.clientHeight / down.size, sin = Math.sin(c.azimuth), cos = Math.cos(c.azimuth);
        c.target[0] += scale * (dx * sin - dy * cos); c.target[1] += scale * (-dx * cos - dy * sin);
      } else { c.azimuth -= dx * 0.006; c.elevation = Math.min(1.55, Math.max(0.06, c.elevation + dy * 0.005)); }
      this.draw();
    });
    const up = (event) => {
      if (down.delete(event.pointerId) && moved < 5 && event.button === 0 && event.type === "pointerup" && !this.busy) {
        const box = canvas.getBoundingClientRect();
        this.onpick(this.pick(event.clientX - box.left, event.clientY - box.top));
      }
    };
    canvas.addEventListener("pointerup", up); canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.camera.distance = Math.min(2000, Math.max(3, this.camera.distance * Math.exp(event.deltaY * 0.001)));
      this.draw();
    }, { passive: false });
  }
}

// ------------------------------------------------------------------------------------------------------- geometry

// Return the area of a grid: its middle, and a radius with which shadows reach beyond it.
function focus(grid) {
  const { front_m, left_m, rows, cols, resolution_m } = grid;
  return { middle: [front_m - (rows * resolution_m) / 2, left_m - (cols * resolution_m) / 2, 0], reach: 0.75 * Math.hypot(rows, cols) * resolution_m };
}

function cube() {
  const corners = [], normals = [];
  for (const axis of [0, 1, 2]) for (const side of [-1, 1]) {
    const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
    for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) {
      const p = [0, 0, 0], n = [0, 0, 0];
      p[axis] = side / 2; p[u] = (side * a) / 2; p[v] = b / 2; n[axis] = side;
      corners.push(...p); normals.push(...n);
    }
  }
  return { corners: new Float32Array(corners), normals: new Float32Array(normals) };
}

function ball(around, up) {
  const at = (i, j) => {
    const a = (2 * Math.PI * i) / around, b = (Math.PI * j) / up;
    return [0.5 * Math.sin(b) * Math.cos(a), 0.5 * Math.sin(b) * Math.sin(a), 0.5 * Math.cos(b)];
  };
  const corners = [];
  for (let i = 0; i < around; i++) for (let j = 0; j < up; j++)
    corners.push(...at(i, j), ...at(i, j + 1), ...at(i + 1, j + 1), ...at(i, j), ...at(i + 1, j + 1), ...at(i + 1, j));
  return { corners: new Float32Array(corners), normals: new Float32Array(corners) };
}

function buffer(gl, data, location, size, each = 0) {
  const made = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, made); gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(location); gl.vertexAttribPointer(location, size, gl.FLOAT, false, 0, 0);
  gl.vertexAttribDivisor(location, each);
  return made;
}

// Return the columns of [R diag(size) | t], four numbers each.
function columns(p) {
  const r = p.rotation, s = p.size_m, found = [];
  for (const k of [0, 1, 2]) found.push([r[k] * s[k], r[3 + k] * s[k], r[6 + k] * s[k], 0]);
  return [...found, [...p.center_m, 1]];
}

function instances(gl, kind, numbers, primitives, coarse) {
  const shape = kind ? (coarse ? COARSE_BALL : BALL) : CUBE, vao = gl.createVertexArray(), data = [0, 1, 2, 3].map(() => new Float32Array(4 * numbers.length));
  const paint = new Float32Array(4 * numbers.length), row = new Map(numbers.map((number, k) => [number, k]));
  const fill = (k, p) => columns(p).forEach((column, c) => data[c].set(column, 4 * k));
  numbers.forEach((number, k) => { fill(k, primitives[number]); paint.set([...linear(primitives[number].color), 1], 4 * k); });
  gl.bindVertexArray(vao);
  const buffers = [buffer(gl, shape.corners, 0, 3), buffer(gl, shape.normals, 1, 3)];
  const placed = data.map((column, c) => buffer(gl, column, 2 + c, 4, 1)), painted = buffer(gl, paint, 6, 4, 1);
  const write = (target, values) => { gl.bindBuffer(gl.ARRAY_BUFFER, target); gl.bufferSubData(gl.ARRAY_BUFFER, 0, values); };
  return {
    kind,
    mark(index) { numbers.forEach((number, k) => { paint[4 * k + 3] = number === index ? 2 : 1; }); write(painted, paint); },
    place(index, p) { const k = row.get(index); if (k !== undefined) { fill(k, p); placed.forEach((target, c) => write(target, data[c])); } },
    placeAll(list) { list.forEach((p, k) => fill(k, p)); placed.forEach((target, c) => write(target, data[c])); },
    draw() { gl.bindVertexArray(vao); gl.drawArraysInstanced(gl.TRIANGLES, 0, shape.corners.length / 3, numbers.length); },
    free() { for (const one of [...buffers, ...placed, painted]) gl.deleteBuffer(one); gl.deleteVertexArray(vao); },
  };
}

function terrain(gl, ground, grid, texture) {
  const { rows, cols, height_cm } = ground, length = grid.rows * grid.resolution_m, width = grid.cols * grid.resolution_m;
  const at = (i, j) => [grid.front_m - (length * i) / (rows - 1), grid.left_m - (width * j) / (cols - 1), height_cm[i * cols + j] / 100];
  const corners = [], places = [], normals = [];
  for (let i = 0; i + 1 < rows; i++) for (let j = 0; j + 1 < cols; j++)
    for (const [a, b] of [[0, 0], [1, 0], [0, 1], [0, 1], [1, 0], [1, 1]]) {
      const [i0, i1, j0, j1] = [Math.max(0, i + a - 1), Math.min(rows - 1, i + a + 1), Math.max(0, j + b - 1), Math.min(cols - 1, j + b + 1)];
      const ahead = at(i0, j + b), behind = at(i1, j + b), left = at(i + a, j0), right = at(i + a, j1);
      corners.push(...at(i + a, j + b)); places.push((j + b) / (cols - 1), (i + a) / (rows - 1));
      normals.push(...normalised([-(ahead[2] - behind[2]) / (ahead[0] - behind[0]), -(left[2] - right[2]) / (left[1] - right[1]), 1]));
    }
  const vao = gl.createVertexArray();
  gl.bindVertexArray(vao);
  const buffers = [buffer(gl, new Float32Array(corners), 0, 3), buffer(gl, new Float32Array(normals), 1, 3), buffer(gl, new Float32Array(places), 7, 2)];
  return {
    kind: 2,
    draw() { gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, texture); gl.bindVertexArray(vao); gl.drawArrays(gl.TRIANGLES, 0, corners.length / 3); },
    free() { buffers.forEach((one) => gl.deleteBuffer(one)); gl.deleteVertexArray(vao); gl.deleteTexture(texture); },
  };
}

async function picture(gl, source) {
  const image = new Image();
  image.src = source;
  await image.decode();
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
  for (const name of ["TEXTURE_WRAP_S", "TEXTURE_WRAP_T"]) gl.texParameteri(gl.TEXTURE_2D, gl[name], gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR); gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

function linked(gl, ...sources) {
  const program = gl.createProgram();
  sources.forEach((source, k) => {
    const shader = gl.createShader(k ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
    gl.shaderSource(shader, source); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  });
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  return program;
}

function shadowMap(gl) {
  const texture = gl.createTexture(), frame = gl.createFramebuffer();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, SHADOW_PX, SHADOW_PX);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR); gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  for (const name of ["TEXTURE_WRAP_S", "TEXTURE_WRAP_T"]) gl.texParameteri(gl.TEXTURE_2D, gl[name], gl.CLAMP_TO_EDGE);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, texture, 0);
  gl.drawBuffers([gl.NONE]); gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return { texture, frame };
}

// Return the length along a ray at which the ray enters a primitive, or Infinity.
function meets(p, from, way) {
  const r = p.rotation, s = p.size_m, d = from.map((f, i) => f - p.center_m[i]);
  const turn = (v) => [0, 1, 2].map((k) => (v[0] * r[k] + v[1] * r[3 + k] + v[2] * r[6 + k]) / s[k]);
  const o = turn(d), w = turn(way);
  if (p.ellipsoid) {
    const a = dot(w, w), b = dot(o, w), c = dot(o, o) - 0.25, inside = b * b - a * c;
    return inside < 0 ? Infinity : (-b - Math.sqrt(inside)) / a;
  }
  let enter = -Infinity, leave = Infinity;
  for (const k of [0, 1, 2]) {
    const [t0, t1] = [(-0.5 - o[k]) / w[k], (0.5 - o[k]) / w[k]];
    enter = Math.max(enter, Math.min(t0, t1)); leave = Math.min(leave, Math.max(t0, t1));
  }
  return enter <= leave && leave > 0 ? enter : Infinity;
}

// ------------------------------------------------------------------------------------------------ linear algebra

function dot(a, b) { return a.reduce((sum, value, i) => sum + value * b[i], 0); }
function normalised(v) { const length = Math.hypot(...v); return v.map((x) => x / length); }
function cross(a, b) { return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]; }
function linear(hex) { return [0, 2, 4].map((i) => (parseInt(hex.slice(i, i + 2), 16) / 255) ** 2.2); }

// 4 x 4 matrices are stored column by column, as in WebGL.
function times(a, b) {
  const m = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) m[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return m;
}
function apply(m, v) { return [0, 1, 2, 3].map((r) => [0, 1, 2, 3].reduce((sum, k) => sum + m[4 * k + r] * v[k], 0)); }
function perspective(angle, aspect, near, far) {
  const f = 1 / Math.tan(angle / 2), d = 1 / (near - far);
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) * d, -1, 0, 0, 2 * far * near * d, 0]);
}
function parallel(reach) { return new Float32Array([1 / reach, 0, 0, 0, 0, 1 / reach, 0, 0, 0, 0, -1 / reach, 0, 0, 0, -1, 1]); }
function looking(eye, target) {
  const z = normalised(eye.map((e, i) => e - target[i])), up = Math.abs(z[2]) > 0.999 ? [1, 0, 0] : [0, 0, 1];
  const x = normalised(cross(up, z)), y = cross(z, x);
  return new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1]);
}
function inverse(m) {  // Gauss-Jordan elimination.
  const a = [0, 1, 2, 3].map((r) => [...[0, 1, 2, 3].map((c) => m[4 * c + r]), ...[0, 1, 2, 3].map((c) => +(c === r))]);
  for (let c = 0; c < 4; c++) {
    let best = c;
    for (let r = c; r < 4; r++) if (Math.abs(a[r][c]) > Math.abs(a[best][c])) best = r;
    [a[c], a[best]] = [a[best], a[c]];
    a[c] = a[c].map((v) => v / a[c][c]);
    for (let r = 0; r < 4; r++) if (r !== c) { const f = a[r][c]; a[r] = a[r].map((v, k) => v - f * a[c][k]); }
  }
  return new Float32Array([0, 1, 2, 3].flatMap((c) => [0, 1, 2, 3].map((r) => a[r][4 + c])));
}
