// The gallery page shows cards of scenes with filters and an order, and one scene at a time in 3D.
// pipelines/reporting/gallery_page.py writes its data.

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const state = { text: "", sort: data.order[0], down: false, choices: {}, low: {}, high: {} };
let viewer = null, shown = -1;

for (const [name, values] of Object.entries(data.choices)) {
  const box = element("label", { textContent: spelled(name) });
  const select = box.appendChild(element("select", { id: `choice-${name}` }));
  for (const value of ["", ...values]) select.append(element("option", { value, textContent: value || "any" }));
  select.onchange = () => { state.choices[name] = select.value; arrange(); };
  $("choices").append(box);
}
const option = (name) => element("option", { value: name, textContent: spelled(name) });
$("sort").append(...data.order.map(option));
$("number").append(...data.order.slice(1).map(option));
$("sort").onchange = () => { state.sort = $("sort").value; arrange(); };
$("down").onclick = () => { state.down = !state.down; $("down").textContent = state.down ? "↓" : "↑"; arrange(); };
$("text").oninput = () => { state.text = $("text").value.toLowerCase(); arrange(); };
$("number").onchange = () => { for (const end of ["low", "high"]) $(end).value = state[end][$("number").value] ?? ""; };
for (const end of ["low", "high"]) $(end).oninput = () => { state[end][$("number").value] = $(end).value; arrange(); };
$("clear").onclick = () => {
  Object.assign(state, { text: "", choices: {}, low: {}, high: {} });
  for (const input of document.querySelectorAll("#filters input, #filters select:not(#sort):not(#number)")) input.value = "";
  arrange();
};

const cards = data.scenes.map((scene, index) => {
  const card = element("button", { className: "card", title: "show the scene in 3D" });
  card.append(element("img", { src: scene.picture, alt: scene.values.scene_id, loading: "lazy" }), element("span", { textContent: scene.values.scene_id }));
  card.append(element("small", { textContent: data.captions.map((name) => scene.values[name]).filter((value) => value !== null).join(" · ") }));
  card.onclick = () => open(index);
  return $("cards").appendChild(card);
});

function fits(values) {
  if (state.text && !values.scene_id.toLowerCase().includes(state.text)) return false;
  for (const [name, value] of Object.entries(state.choices)) if (value && String(values[name]) !== value) return false;
  for (const [name, value] of Object.entries(state.low)) if (value !== "" && !(values[name] >= +value)) return false;
  for (const [name, value] of Object.entries(state.high)) if (value !== "" && !(values[name] <= +value)) return false;
  return true;
}

function arrange() {
  const order = data.scenes.map((_, index) => index).filter((index) => fits(data.scenes[index].values));
  const key = (index) => data.scenes[index].values[state.sort];
  order.sort((a, b) => (key(a) === key(b) ? a - b : key(a) === null ? 1 : key(b) === null ? -1 : (key(a) < key(b)) !== state.down ? -1 : 1));
  for (const card of cards) card.hidden = true;
  for (const index of order) { cards[index].hidden = false; $("cards").append(cards[index]); }
  $("count").textContent = `${order.length} of ${data.scenes.length} scenes`;
}

async function open(index) {
  const scene = data.scenes[index];
  shown = index;
  $("dialog").showModal();
  $("name").textContent = scene.values.scene_id;
  $("values").replaceChildren(...Object.entries(scene.values).filter(([, value]) => value !== null && value !== 0).flatMap(([name, value]) => [element("dt", { textContent: spelled(name) }), element("dd", { textContent: value })]));
  const bytes = Uint8Array.from(atob(scene.packed), (letter) => letter.charCodeAt(0));
  const content = await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).json();
  if (shown !== index) return;
  $("picked").textContent = "Click an object to see its values. Drag to rotate the view. Drag with the right button to move the view. Turn the wheel to zoom.";
  viewer ??= new Viewer($("view"));
  viewer.onpick = (number) => {
    viewer.choose(number);
    const p = content.primitives[number];
    $("picked").textContent = p ? `${number}: ${spelled(p.category)} (${p.label}), ${p.size_m.map((value) => value.toFixed(2)).join(" × ")} m at ${p.center_m.map((value) => value.toFixed(2)).join(", ")} m, existence ${p.existence}` : "";
  };
  viewer.chosen = -1;
  await viewer.show(content);
  document.body.dataset.shown = scene.values.scene_id;
}

function step(by) {
  const visible = [...$("cards").children].filter((card) => !card.hidden), at = visible.indexOf(cards[shown]);
  if (visible.length) open(cards.indexOf(visible[(at + by + visible.length) % visible.length]));
}
$("close").onclick = () => $("dialog").close();
$("previous").onclick = () => step(-1);
$("next").onclick = () => step(1);
addEventListener("keydown", (event) => { if ($("dialog").open && event.key === "ArrowLeft") step(-1); if ($("dialog").open && event.key === "ArrowRight") step(1); });

function element(kind, properties) { return Object.assign(document.createElement(kind), properties); }
function spelled(name) { return name.replace(/_m2$/, ", m²").replace(/_m3$/, ", m³").replace(/^num_/, "number of ").replaceAll("_", " "); }
arrange();
