// The page of depthpose serve: tabs, drop zones, answers. No library, and no other server.
const makeElement = (name, facts = {}, ...children) => {
  const element = Object.assign(document.createElement(name), facts);
  element.append(...children);
  return element;
};

// Tabs: the address ends in #depth or #pose, arrow keys go from one to the other.
const tabs = [...document.querySelectorAll("[role=tab]")];
function chooseTab(tab) {
  for (const candidate of tabs) {
    const isChosen = candidate === tab;
    candidate.setAttribute("aria-selected", isChosen);
    candidate.tabIndex = isChosen ? 0 : -1;
    document.getElementById(candidate.getAttribute("aria-controls")).hidden = !isChosen;
  }
}
const address = tab => `#${tab.getAttribute("aria-controls")}`;
for (const tab of tabs) {
  tab.addEventListener("click", () => { chooseTab(tab); history.replaceState(null, "", address(tab)); });
  tab.addEventListener("keydown", event => {
    if (event.key !== "ArrowLeft" && event.key !== "ArrowRight") return;
    const other = tabs[1 - tabs.indexOf(tab)];
    other.click();
    other.focus();
  });
}
chooseTab(tabs.find(tab => address(tab) === location.hash) || tabs[0]);
// An address that ends in #pose names the tab; the browser would scroll past the tabs to it.
addEventListener("load", () => scrollTo(0, 0));

// Drop zones show the chosen file, with a button to remove it.
for (const zone of document.querySelectorAll(".drop")) {
  const input = zone.querySelector("input"), label = zone.querySelector("output");
  const show = () => {
    const file = input.files[0];
    label.textContent = file ? `${file.name}, ${formatSize(file.size)}` : "";
    zone.classList.toggle("has", Boolean(file));
    if (file && input.name === "cad") input.form.elements.object.value = "cad";
  };
  input.addEventListener("change", show);
  const drop = makeElement("button", { type: "button", className: "drop-it", textContent: "\u00d7", title: "take the file out" });
  drop.addEventListener("click", event => { event.preventDefault(); input.value = ""; show(); });
  zone.append(drop);
  for (const name of ["dragenter", "dragover"]) zone.addEventListener(name, () => zone.classList.add("over"));
  for (const name of ["dragleave", "drop"]) zone.addEventListener(name, () => zone.classList.remove("over"));
}
// A file that misses its zone must not replace the page.
for (const name of ["dragover", "drop"]) addEventListener(name, event => {
  if (!event.target.closest?.(".drop")) event.preventDefault();
});

function formatSize(bytes) {
  return bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}

// An example fills the form and submits it.
for (const button of document.querySelectorAll(".try")) button.addEventListener("click", async () => {
  const form = button.form;
  button.disabled = true;
  const response = await fetch(`examples/${form.dataset.kind}`).catch(() => null);
  const example = await response?.json().catch(() => null);
  button.disabled = false;
  if (!example?.files) {
    const textContent = example?.error || "the server does not answer; is 'depthpose serve' still running?";
    form.parentElement.querySelector(".answer").replaceChildren(makeElement("p", { className: "said failed", role: "alert", textContent }));
    return;
  }
  form.reset();
  for (const input of form.querySelectorAll("input[type=file]")) {
    const file = example.files.find(candidate => candidate.field === input.name), transfer = new DataTransfer();
    if (file) transfer.items.add(new File([Uint8Array.from(atob(file.data), c => c.charCodeAt(0))], file.name));
    input.files = transfer.files;
    input.dispatchEvent(new Event("change"));
  }
  for (const [name, value] of Object.entries(example.fields)) form.elements[name].value = value;
  form.requestSubmit(form.querySelector(".go"));
});

for (const form of document.forms) form.addEventListener("submit", async event => {
  event.preventDefault();
  const answer = form.parentElement.querySelector(".answer"), button = form.querySelector(".go");
  const words = button.textContent, began = performance.now();
  const ticket = Math.random().toString(36).slice(2);
  let before = null;
  const tick = setInterval(() => {
    const state = before ? `waiting, ${before} before you` : "computing";
    button.textContent = `${state}, ${Math.round((performance.now() - began) / 1000)} s`;
  }, 200);
  const ask = setInterval(async () => {
    const response = await fetch(`queue/${ticket}`).catch(() => null);
    before = (await response?.json().catch(() => null))?.before;
  }, 1000);
  button.disabled = true;
  answer.setAttribute("aria-busy", "true");
  let result;
  try {
    const response = await fetch(`estimate/${form.dataset.kind}`, {
      method: "POST", body: new FormData(form), headers: { "X-Ticket": ticket },
    });
    result = await response.json();
  } catch {
    result = { error: "the server does not answer; is 'depthpose serve' still running?" };
  }
  clearInterval(tick);
  clearInterval(ask);
  button.textContent = words;
  button.disabled = false;
  answer.removeAttribute("aria-busy");
  answer.querySelector(".scene")?.stopScene?.();
  answer.replaceChildren();
  if (result.error) answer.append(makeElement("p", { className: "said failed", role: "alert", textContent: result.error }));
  else showAnswer(answer, result);
});

function showAnswer(answer, result) {
  const scene = makeElement("div");
  const note = result.scene.note ? ` (${result.scene.note})` : "";
  answer.append(
    makeElement("p", { className: `said ${result.ok ? "" : "refused"}`, textContent: result.sentence }),
    ...(result.terms ? [makeElement("p", { className: "terms" },
      makeElement("b", { textContent: "Terms of the weights: " }), result.terms)] : []),
    makeElement("dl", { className: "facts" }, ...result.facts.flatMap(([name, value]) =>
      [makeElement("dt", { textContent: name }), makeElement("dd", { textContent: value })])),
    makeElement("figure", { className: "space" }, scene,
      makeElement("figcaption", { textContent: result.scene.caption + note })),
    makeElement("div", { className: "pictures" }, ...result.pictures.map(picture => makeFigure(picture, result.folder))),
    ...Object.entries(result.tables).flatMap(([title, rows]) => [makeElement("h3", { textContent: title }), makeTable(rows)]),
    makeElement("h3", { textContent: "Downloads" }),
    makeElement("ul", { className: "downloads" }, ...[...result.files, { name: "all.zip" }].map(({ name, bytes }) =>
      makeElement("li", {}, makeElement("a", { href: result.folder + encodeURIComponent(name), download: name,
        textContent: bytes === undefined ? name : `${name}, ${formatSize(bytes)}` })))),
  );
  showScene(scene, result.scene);
}

function makeTable(rows) {
  const cells = row => row.map((text, k) =>
    makeElement("td", { textContent: text, className: k === 0 && isNaN(text) ? "head" : "" }));
  return makeElement("div", { className: "table" }, makeElement("table", {}, ...rows.map(row => makeElement("tr", {}, ...cells(row)))));
}

// A picture; where there are numbers behind it, the one under the pointer is read out.
function makeFigure(picture, folder) {
  const [width, height] = picture.size;
  const image = makeElement("img", { src: folder + encodeURIComponent(picture.file), alt: picture.caption, width, height });
  const read = makeElement("span", { className: "read" });
  const bar = picture.scale ? [makeColorBar(picture.scale)] : [];
  const figure = makeElement("figure", {}, image, ...bar, makeElement("figcaption", {}, picture.caption, read));
  if (!picture.values) return figure;
  let map;
  image.addEventListener("pointerenter", async () => {
    map ??= fetch(folder + encodeURIComponent(picture.values)).then(async r => r.ok && readNpy(await r.arrayBuffer()));
  });
  image.addEventListener("pointermove", async event => {
    const values = await map, box = image.getBoundingClientRect();
    if (!values) return;
    const u = Math.min(Math.max(Math.floor((event.clientX - box.left) / box.width * values.width), 0), values.width - 1);
    const v = Math.min(Math.max(Math.floor((event.clientY - box.top) / box.height * values.height), 0), values.height - 1);
    const value = values.data[v * values.width + u];
    read.textContent = `. At (${u}, ${v}): ${Number.isNaN(value) ? "none" : `${value.toFixed(2)} ${picture.unit}`}`;
  });
  image.addEventListener("pointerleave", () => { read.textContent = ""; });
  return figure;
}

// The bar of a picture's colours, with its numbers.
function makeColorBar({ title, colors, marks }) {
  const bar = makeElement("div", { className: "bar" }), rgb = colors.map(c => `rgb(${c.map(v => Math.round(255 * v))})`);
  bar.style.background = `linear-gradient(to right, ${rgb})`;
  const numbers = marks.map(([place, textContent]) => {
    const mark = makeElement("span", { textContent });
    mark.style.left = `${100 * place}%`;
    return mark;
  });
  return makeElement("div", { className: "scale" }, bar, makeElement("div", { className: "marks" }, ...numbers),
    makeElement("div", { className: "of", textContent: title }));
}

// NPY, version 1, float32, row by row: what the server writes.
function readNpy(buffer) {
  const length = new DataView(buffer).getUint16(8, true);
  const header = new TextDecoder().decode(new Uint8Array(buffer, 10, length));
  const [, height, width] = header.match(/\((\d+), (\d+)\)/).map(Number);
  return { width, height, data: new Float32Array(buffer.slice(10 + length)) };
}
