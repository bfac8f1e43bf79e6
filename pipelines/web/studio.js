// The page of the studio. pipelines/studio/api.py lists the requests that the server accepts.
import { Viewer } from "/viewer.js";

const $ = (id) => document.getElementById(id);
const viewer = new Viewer($("view"));
let scene = null, chosen = -1, region = [], start = 0, dragging = false, watching = false;

async function ask(path, body) {
  const options = body === undefined ? {} : { method: "POST", headers: { "content-type": "application/json", "x-studio": "1" }, body: JSON.stringify(body) };
  const response = await fetch(path, options);
  if (!response.ok) {
    let reason = await response.text();
    try { const detail = JSON.parse(reason).detail; reason = typeof detail === "string" ? detail : detail.map((d) => `${d.loc.at(-1)}: ${d.msg}`).join("; "); } catch { /* The reason is plain text. */ }
    throw new Error(reason);
  }
  return response.json();
}

function say(text, wrong = false) { $("said").textContent = text; $("said").classList.toggle("wrong", wrong); }

// Sends a request, then shows the new state or the error.
async function act(path, body, keep = false) {
  try { say(""); await show(await ask(path, body), keep); } catch (error) { say(error.message, true); }
}

async function show(state, keep = false) {
  playing = false; viewer.showMoving(null);
  scene = state.scene;
  $("undo").disabled = !state.undo; $("undo").title = state.undo ?? "";
  $("redo").disabled = !state.redo; $("redo").title = state.redo ?? "";
  for (const id of ["glb", "xodr", "json"]) $(id).hidden = !scene;
  $("name").textContent = scene ? `${scene.scene_id} · ${scene.primitives.length} primitives` : "no scene";
  if (scene) {
    await viewer.show(scene);
    choose(keep && chosen < scene.primitives.length ? chosen : -1);
    await drawMap();
  }
  await loadTraffic();
  document.body.dataset.shown = scene ? `${scene.scene_id}/${scene.primitives.length}/${state.undo}` : "";
  if (state.work && !state.work.finished) watch();
}

function choose(index) {
  chosen = index; viewer.choose(index);
  const p = scene?.primitives[index];
  $("picked").textContent = p ? `${index}: ${p.category.replaceAll("_", " ")} (${p.label}), ${p.size_m.map((v) => v.toFixed(2)).join(" × ")} m, at ${p.center_m.map((v) => v.toFixed(2)).join(", ")} m` : "Click an object to select it. Drag to rotate the view. Drag with the right button to move the view. Turn the wheel to zoom.";
  for (const button of document.querySelectorAll("[data-edit], #drag")) button.disabled = !p;
}
viewer.onpick = choose;

// ------------------------------------------------------------------------------------------------------ tasks

async function watch() {
  if (watching) return;
  watching = true;
  $("progress").hidden = $("cancel").hidden = false;
  let work;
  do {
    await new Promise((done) => setTimeout(done, 250));
    work = await ask("/api/work").catch(() => ({ finished: true, error: "The studio does not answer." }));
    $("progress").max = work.total || 1; $("progress").value = work.done || 0;
    const left = work.estimate_s == null ? "" : `, about ${work.estimate_s} s left`;
    say(`${work.name ?? ""}: ${work.position ? `number ${work.position} in the queue` : `step ${work.done ?? 0} of ${work.total ?? 0}`}${left}`);
  } while (!work.finished);
  watching = false;
  $("progress").hidden = $("cancel").hidden = true;
  await act("/api/state");
  say(work.error || (work.cancelled ? "The task is cancelled." : ""), Boolean(work.error));
  document.body.dataset.work = work.error ? "failed" : work.cancelled ? "cancelled" : "done";
}
$("cancel").onclick = () => ask("/api/cancel", {}).catch((error) => say(error.message, true));

const sampling = () => ({ label: $("label").value, seed: Math.max(0, Math.floor(+$("seed").value || 0)), steps: Math.max(1, Math.floor(+$("steps").value || 20)), constraints: $("constraints").checked });
$("generate").onclick = () => act("/api/generate", sampling());
$("another").onclick = () => { $("seed").value = Math.floor(Math.random() * 2 ** 31); $("generate").click(); };
$("inpaint").onclick = () => act("/api/inpaint", { ...sampling(), polygon_m: region, contents: $("contents").value });
for (const button of document.querySelectorAll("[data-side]")) button.onclick = () => act("/api/extend", { ...sampling(), side: button.dataset.side });
$("undo").onclick = () => act("/api/undo", {});
$("redo").onclick = () => act("/api/redo", {});

// --------------------------------------------------------------------------------------------------------- traffic

let traffic = { objects: [], driving: [] }, began = 0, playing = false, traced = "";
const SPEED = 2, HIDDEN = [0.001, 0.001, 0.001];

async function loadTraffic() {
  // After an edit, the indices of the vehicles in traffic may be others.
  const key = scene ? scene.scene_id + JSON.stringify(scene.primitives.map((p) => [p.category, p.center_m])) : "";
  if (key !== traced) {
    traced = key; traffic = { objects: [], driving: [] };
    if (scene) try { traffic = await ask("/api/tracks"); } catch (error) { traced = ""; say(error.message, true); }
  }
  $("play").hidden = !traffic.objects.length; $("play").textContent = "▶ Traffic";
}

// Returns the box of a road user at a time.
function boxAt({ color, size_m, time_s, places }, time) {
  const last = time_s.length - 1, there = time >= time_s[0] && time <= time_s[last];
  let k = 0;
  while (k < last - 1 && time_s[k + 1] <= time) k++;
  const a = places[k], b = places[Math.min(k + 1, last)], share = last ? Math.min(1, Math.max(0, (time - time_s[k]) / (time_s[Math.min(k + 1, last)] - time_s[k] || 1))) : 0;
  const turn = Math.atan2(Math.sin(b[3] - a[3]), Math.cos(b[3] - a[3])), yaw = a[3] + share * turn, [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return { color, size_m: there ? size_m : HIDDEN, center_m: [0, 1, 2].map((i) => a[i] + share * (b[i] - a[i])), rotation: [c, -s, 0, s, c, 0, 0, 0, 1] };
}

function playFrame(now) {
  if (!playing) return;
  const end = Math.max(...traffic.objects.map((one) => one.time_s.at(-1))), time = (((now - began) / 1000) * SPEED) % end;
  viewer.showMoving(traffic.objects.map((one) => boxAt(one, time)));
  $("name").textContent = `${scene.scene_id} · ${time.toFixed(0)} of ${end.toFixed(0)} s`;
  document.body.dataset.time = time.toFixed(2);
  requestAnimationFrame(playFrame);
}

$("play").onclick = () => {
  playing = !playing;
  $("play").textContent = playing ? "■ Stop" : "▶ Traffic";
  for (const index of traffic.driving) if (scene.primitives[index]) viewer.move(index, playing ? { ...scene.primitives[index], size_m: HIDDEN } : scene.primitives[index]);
  if (playing) { began = performance.now(); requestAnimationFrame(playFrame); } else { viewer.showMoving(null); $("name").textContent = `${scene.scene_id} · ${scene.primitives.length} primitives`; }
};

// ----------------------------------------------------------------------------------------------------------- edits

function edit(name) {
  if (chosen < 0 && name !== "repair") return;
  const step = Math.abs(+$("step").value) || 1, select = { primitives: [chosen] };
  const moves = { ahead: [step, 0, 0], behind: [-step, 0, 0], left: [0, step, 0], right: [0, -step, 0] };
  const edits = {
    turn: { edit: "rotate", select, by_deg: 15 }, back: { edit: "rotate", select, by_deg: -15 },
    snap: { edit: "snap", select }, copy: { edit: "duplicate", select, by_m: [0, -step, 0] }, remove: { edit: "remove", select },
  };
  act("/api/edit", { edits: [name in moves ? { edit: "translate", select, by_m: moves[name] } : edits[name]] }, name !== "remove");
}
for (const button of document.querySelectorAll("[data-edit]")) button.onclick = () => edit(button.dataset.edit);
$("repair").onclick = () => scene && act("/api/edit", { edits: [{ edit: "repair", select: { category: [...new Set(scene.primitives.map((p) => p.category))] } }] });
addEventListener("keydown", (event) => {
  if (/INPUT|SELECT|TEXTAREA/.test(event.target.tagName)) return;
  const keys = { ArrowUp: "ahead", ArrowDown: "behind", ArrowLeft: "left", ArrowRight: "right", r: "turn", R: "back", d: "copy", Delete: "remove", Backspace: "remove" };
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") { (event.shiftKey ? $("redo") : $("undo")).click(); event.preventDefault(); }
  else if (keys[event.key] && !event.ctrlKey && !event.metaKey) { edit(keys[event.key]); event.preventDefault(); }
});

// Dragging moves the selected object in the horizontal plane through its centre.
$("drag").onclick = () => { dragging = viewer.busy = !dragging; $("drag").textContent = dragging ? "Press on the object and drag it." : "Drag"; };
let from = null;
const place = (event) => { const box = $("view").getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
$("view").addEventListener("pointerdown", (event) => {
  if (dragging && chosen >= 0) from = viewer.onPlane(...place(event), scene.primitives[chosen].center_m[2]);
});
$("view").addEventListener("pointermove", (event) => {
  if (!from) return;
  const p = scene.primitives[chosen], to = viewer.onPlane(...place(event), p.center_m[2]);
  if (to) viewer.move(chosen, { ...p, center_m: p.center_m.map((v, i) => v + to[i] - from[i]) });
});
$("view").addEventListener("pointerup", (event) => {
  if (!from) return;
  const to = viewer.onPlane(...place(event), scene.primitives[chosen].center_m[2]), by = to ? [to[0] - from[0], to[1] - from[1], 0] : [0, 0, 0];
  from = null; $("drag").click();
  if (Math.hypot(...by) > 0.02) act("/api/edit", { edits: [{ edit: "translate", select: { primitives: [chosen] }, by_m: by }] }, true);
});

// --------------------------------------------------------------------------------------------------- map and region

const map = $("map"), brush = map.getContext("2d");
let ground = null, drawing = false;

function mapScale() { const g = scene.grid; return map.width / Math.max(g.rows, g.cols) / g.resolution_m; }
function toMap([x, y]) { const s = mapScale(), g = scene.grid; return [(g.left_m - y) * s, (g.front_m - x) * s]; }
function toScene(event) {
  const box = map.getBoundingClientRect(), s = mapScale(), g = scene.grid;
  return [g.front_m - ((event.clientY - box.top) * map.height) / box.height / s, g.left_m - ((event.clientX - box.left) * map.width) / box.width / s];
}
async function drawMap() {
  ground = new Image(); ground.src = scene.ground.picture; await ground.decode();
  region = []; paintMap();
}
function paintMap() {
  const s = mapScale(), g = scene.grid;
  brush.fillStyle = "#fff"; brush.fillRect(0, 0, map.width, map.height); brush.imageSmoothingEnabled = false;
  brush.drawImage(ground, 0, 0, g.cols * g.resolution_m * s, g.rows * g.resolution_m * s);
  for (const p of scene.primitives) {
    const [x, y] = toMap(p.center_m), r = p.rotation;
    brush.fillStyle = `#${p.color}`; brush.beginPath();
    if (p.ellipsoid) brush.ellipse(x, y, (p.size_m[1] / 2) * s, (p.size_m[0] / 2) * s, -Math.atan2(r[3], r[0]), 0, 2 * Math.PI);
    else for (const [a, b] of [[1, 1], [1, -1], [-1, -1], [-1, 1]]) {
      const corner = [0, 1].map((i) => p.center_m[i] + (a * r[3 * i] * p.size_m[0] + b * r[3 * i + 1] * p.size_m[1]) / 2);
      brush.lineTo(...toMap(corner));
    }
    brush.fill();
  }
  if (region.length) {
    brush.beginPath(); for (const point of region) brush.lineTo(...toMap(point)); brush.closePath();
    brush.fillStyle = "#ff8c0044"; brush.fill(); brush.strokeStyle = "#ff8c00"; brush.lineWidth = 3; brush.stroke();
  }
  $("inpaint").disabled = region.length < 3;
}
map.addEventListener("pointerdown", (event) => { if (scene) { drawing = true; region = [toScene(event)]; map.setPointerCapture(event.pointerId); } });
map.addEventListener("pointermove", (event) => {
  if (!drawing) return;
  const point = toScene(event), last = region.at(-1);
  if (Math.hypot(point[0] - last[0], point[1] - last[1]) > 0.4 && region.length < 490) { region.push(point); paintMap(); }
});
map.addEventListener("pointerup", () => { drawing = false; paintMap(); });

// ------------------------------------------------------------------------------------------------------------ scenes of the datasets

async function list() {
  try {
    const page = await ask(`/api/scenes?start=${start}&text=${encodeURIComponent($("text").value)}`);
    $("list").replaceChildren(...page.scenes.map((one) => {
      const button = document.createElement("button"), image = document.createElement("img");
      image.src = one.picture; image.alt = "";
      button.append(image, one.scene_id); button.onclick = () => act("/api/open", { scene_id: one.scene_id });
      return button;
    }));
    $("where").textContent = page.total ? `${page.start + 1} to ${page.start + page.scenes.length} of ${page.total}` : "none";
    $("back").disabled = start === 0; $("on").disabled = page.start + page.scenes.length >= page.total;
  } catch (error) { say(error.message, true); }
}
$("text").oninput = () => { start = 0; list(); };
$("back").onclick = () => { start = Math.max(0, start - 24); list(); };
$("on").onclick = () => { start += 24; list(); };

const about = await ask("/api/about");
$("constraints").checked = about.constraints;
for (const label of about.labels) $("label").append(Object.assign(document.createElement("option"), { value: label, textContent: label }));
await list();
await act("/api/state");
document.body.dataset.ready = "yes";
