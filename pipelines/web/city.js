// The city page shows the tiles near the point at which the camera looks in 3D, and pictures of the others.
// pipelines/reporting/city_page.py writes its data and the tiles.
//
// A tile is a script, because pages that are opened as files cannot fetch other files. Each script calls tile(name,
// content) or overview(name, content), where the content is a scene of pipelines/io/web_export.py as JSON, packed with gzip and base64.

const data = JSON.parse(document.getElementById("data").textContent);
const viewer = new Viewer(document.getElementById("view"));
const tiles = new Map(data.tiles.map((tile) => [tile.name, { ...tile, parts: null, loading: false, far: null, farParts: null }]));
const keys = new Set();
let flying = false, last = 0;

viewer.camera = { target: [...data.start_m, 0], distance: 180, azimuth: Math.PI, elevation: 0.6 };
viewer.onmove = () => { viewer.focus = { middle: [...viewer.camera.target], reach: reach() }; choose(); };

// Return the distance up to which tiles are loaded (m).
function reach() { return Math.min(data.max_reach_m, Math.max(150, 2 * viewer.camera.distance)); }

// Return the horizontal distance between the target of the camera and a tile (m).
function distance(tile) {
  const [x, y] = viewer.camera.target, [x0, y0, x1, y1] = tile.bounds_m;
  return Math.hypot(Math.max(x0 - x, 0, x - x1), Math.max(y0 - y, 0, y - y1));
}

// Load the tiles within reach, nearest first, and remove those far beyond it.
function choose() {
  const order = [...tiles.values()].sort((a, b) => distance(a) - distance(b));
  for (const tile of order) {
    if (tile.parts && distance(tile) > 1.3 * reach()) { viewer.remove(tile.parts); tile.parts = null; showFar(tile); }
    if (!tile.parts && !tile.loading && distance(tile) <= reach()) {
      tile.loading = true;
      load(tile.name, () => { document.getElementById("count").textContent = `tiles/${tile.name}.js cannot be read`; });
    }
  }
  const shown = order.filter((tile) => tile.parts).length;
  document.getElementById("count").textContent = `${shown} of ${tiles.size} tiles`;
}

function load(name, onerror) {
  const script = document.createElement("script");
  script.src = `tiles/${name}.js`;
  script.onerror = onerror;
  document.head.append(script);
}

async function unpack(name, content) {
  const bytes = Uint8Array.from(atob(content), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  for (const script of document.querySelectorAll(`script[src="tiles/${name}.js"]`)) script.remove();
  return new Response(stream).json();
}

window.tile = async (name, content) => {
  const tile = tiles.get(name);
  tile.parts = await viewer.add(await unpack(name, content), true);
  tile.loading = false;
  showFar(tile);
};

// Each tile also has a picture on coarse ground, which is shown until the tile is loaded.
window.overview = async (name, content) => {
  const tile = tiles.get(name);
  tile.far = await unpack(`${name}-far`, content);
  showFar(tile);
};

// Show or remove the view of a tile from afar, depending on whether the tile is shown.
async function showFar(tile) {
  if (tile.far && !tile.parts && !tile.farParts) {
    tile.farParts = [];
    tile.farParts = await viewer.add(tile.far, true);
  }
  if (tile.parts && tile.farParts?.length) { viewer.remove(tile.farParts); tile.farParts = null; }
  const far = [...tiles.values()].filter((one) => one.farParts?.length).length;
  document.getElementById("view").dataset.far = far;
  viewer.draw();
}

for (const tile of tiles.values()) load(`${tile.name}-far`, () => {});  // A missing picture is no error.

// Keys move the camera: W, A, S, D or arrows; Q and E turn it. The button flies along the view and turns at the border.
addEventListener("keydown", (event) => { keys.add(event.key.toLowerCase()); step(0); });
addEventListener("keyup", (event) => keys.delete(event.key.toLowerCase()));
document.getElementById("fly").onclick = () => {
  flying = !flying;
  document.getElementById("fly").textContent = flying ? "stop" : "fly";
  step(0);
};

function step(now) {
  if (!keys.size && !flying) { last = 0; return; }
  if (now && last) {
    const c = viewer.camera, way = c.distance * 0.6 * Math.min(0.1, (now - last) / 1000);
    const held = (...names) => names.some((name) => keys.has(name));
    const ahead = held("w", "arrowup") - held("s", "arrowdown") + 0.5 * flying, aside = held("a", "arrowleft") - held("d", "arrowright");
    c.azimuth += (held("q") - held("e")) * 0.03;
    const forward = [-Math.cos(c.azimuth), -Math.sin(c.azimuth)], left = [-forward[1], forward[0]];
    for (const k of [0, 1]) c.target[k] += way * (ahead * forward[k] + aside * left[k]);
    const [x0, y0, x1, y1] = data.bounds_m;
    if (flying && (c.target[0] < x0 || c.target[0] > x1 || c.target[1] < y0 || c.target[1] > y1)) c.azimuth += 0.02;
    c.target[0] = Math.min(x1, Math.max(x0, c.target[0])); c.target[1] = Math.min(y1, Math.max(y0, c.target[1]));
    viewer.draw();
  }
  if (now) last = now;
  if (!step.waiting) { step.waiting = true; requestAnimationFrame((time) => { step.waiting = false; step(time); }); }
}
