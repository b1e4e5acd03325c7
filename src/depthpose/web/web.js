// The page of depthpose serve: tabs, drop zones, answers. No library, and no other server.
const made = (name, facts = {}, ...children) => {
  const element = Object.assign(document.createElement(name), facts);
  element.append(...children);
  return element;
};

// Tabs: the address ends in #depth or #pose, arrow keys go from one to the other.
const tabs = [...document.querySelectorAll("[role=tab]")];
function choose(tab) {
  for (const one of tabs) {
    const isChosen = one === tab;
    one.setAttribute("aria-selected", isChosen);
    one.tabIndex = isChosen ? 0 : -1;
    document.getElementById(one.getAttribute("aria-controls")).hidden = !isChosen;
  }
}
const address = tab => `#${tab.getAttribute("aria-controls")}`;
for (const tab of tabs) {
  tab.addEventListener("click", () => { choose(tab); history.replaceState(null, "", address(tab)); });
  tab.addEventListener("keydown", event => {
    if (event.key !== "ArrowLeft" && event.key !== "ArrowRight") return;
    const other = tabs[1 - tabs.indexOf(tab)];
    other.click();
    other.focus();
  });
}
choose(tabs.find(tab => address(tab) === location.hash) || tabs[0]);
// An address that ends in #pose names the tab; the browser would scroll past the tabs to it.
addEventListener("load", () => scrollTo(0, 0));

// Drop zones show the chosen file, with a button to remove it.
for (const zone of document.querySelectorAll(".drop")) {
  const input = zone.querySelector("input"), said = zone.querySelector("output");
  const show = () => {
    const file = input.files[0];
    said.textContent = file ? `${file.name}, ${sized(file.size)}` : "";
    zone.classList.toggle("has", Boolean(file));
    if (file && input.name === "cad") input.form.elements.object.value = "cad";
  };
  input.addEventListener("change", show);
  const drop = made("button", { type: "button", className: "drop-it", textContent: "\u00d7", title: "take the file out" });
  drop.addEventListener("click", event => { event.preventDefault(); input.value = ""; show(); });
  zone.append(drop);
  for (const name of ["dragenter", "dragover"]) zone.addEventListener(name, () => zone.classList.add("over"));
  for (const name of ["dragleave", "drop"]) zone.addEventListener(name, () => zone.classList.remove("over"));
}
// A file that misses its zone must not replace the page.
for (const name of ["dragover", "drop"]) addEventListener(name, event => {
  if (!event.target.closest?.(".drop")) event.preventDefault();
});

function sized(bytes) {
  return bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}

// An example fills the form and submits it.
for (const button of document.querySelectorAll(".try")) button.addEventListener("click", async () => {
  const form = button.form;
  button.disabled = true;
  const response = await fetch(`examples/${form.dataset.kind}`).catch(() => null);
  const found = await response?.json().catch(() => null);
  button.disabled = false;
  if (!found?.files) {
    const textContent = found?.error || "the server does not answer; is 'depthpose serve' still running?";
    form.parentElement.querySelector(".answer").replaceChildren(made("p", { className: "said failed", role: "alert", textContent }));
    return;
  }
  form.reset();
  for (const input of form.querySelectorAll("input[type=file]")) {
    const file = found.files.find(one => one.field === input.name), held = new DataTransfer();
    if (file) held.items.add(new File([Uint8Array.from(atob(file.data), c => c.charCodeAt(0))], file.name));
    input.files = held.files;
    input.dispatchEvent(new Event("change"));
  }
  for (const [name, value] of Object.entries(found.fields)) form.elements[name].value = value;
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
  let found;
  try {
    const response = await fetch(`estimate/${form.dataset.kind}`, {
      method: "POST", body: new FormData(form), headers: { "X-Ticket": ticket },
    });
    found = await response.json();
  } catch {
    found = { error: "the server does not answer; is 'depthpose serve' still running?" };
  }
  clearInterval(tick);
  clearInterval(ask);
  button.textContent = words;
  button.disabled = false;
  answer.removeAttribute("aria-busy");
  answer.querySelector(".scene")?.stopScene?.();
  answer.replaceChildren();
  if (found.error) answer.append(made("p", { className: "said failed", role: "alert", textContent: found.error }));
  else show(answer, found);
});

function show(answer, found) {
  const scene = made("div");
  const note = found.scene.note ? ` (${found.scene.note})` : "";
  answer.append(
    made("p", { className: `said ${found.ok ? "" : "refused"}`, textContent: found.sentence }),
    ...(found.terms ? [made("p", { className: "terms" },
      made("b", { textContent: "Terms of the weights: " }), found.terms)] : []),
    made("dl", { className: "facts" }, ...found.facts.flatMap(([name, value]) =>
      [made("dt", { textContent: name }), made("dd", { textContent: value })])),
    made("figure", { className: "space" }, scene,
      made("figcaption", { textContent: found.scene.caption + note })),
    made("div", { className: "pictures" }, ...found.pictures.map(picture => shown(picture, found.folder))),
    ...Object.entries(found.tables).flatMap(([title, rows]) => [made("h3", { textContent: title }), table(rows)]),
    made("h3", { textContent: "Downloads" }),
    made("ul", { className: "downloads" }, ...[...found.files, { name: "all.zip" }].map(({ name, bytes }) =>
      made("li", {}, made("a", { href: found.folder + encodeURIComponent(name), download: name,
        textContent: bytes === undefined ? name : `${name}, ${sized(bytes)}` })))),
  );
  showScene(scene, found.scene);
}

function table(rows) {
  const cells = row => row.map((text, k) =>
    made("td", { textContent: text, className: k === 0 && isNaN(text) ? "head" : "" }));
  return made("div", { className: "table" }, made("table", {}, ...rows.map(row => made("tr", {}, ...cells(row)))));
}

// A picture; where there are numbers behind it, the one under the pointer is read out.
function shown(picture, folder) {
  const [width, height] = picture.size;
  const image = made("img", { src: folder + encodeURIComponent(picture.file), alt: picture.caption, width, height });
  const read = made("span", { className: "read" });
  const bar = picture.scale ? [scaled(picture.scale)] : [];
  const figure = made("figure", {}, image, ...bar, made("figcaption", {}, picture.caption, read));
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
function scaled({ title, colors, marks }) {
  const bar = made("div", { className: "bar" }), rgb = colors.map(c => `rgb(${c.map(v => Math.round(255 * v))})`);
  bar.style.background = `linear-gradient(to right, ${rgb})`;
  const numbers = marks.map(([place, textContent]) => {
    const mark = made("span", { textContent });
    mark.style.left = `${100 * place}%`;
    return mark;
  });
  return made("div", { className: "scale" }, bar, made("div", { className: "marks" }, ...numbers),
    made("div", { className: "of", textContent: title }));
}

// NPY, version 1, float32, row by row: what the server writes.
function readNpy(buffer) {
  const length = new DataView(buffer).getUint16(8, true);
  const header = new TextDecoder().decode(new Uint8Array(buffer, 10, length));
  const [, height, width] = header.match(/\((\d+), (\d+)\)/).map(Number);
  return { width, height, data: new Float32Array(buffer.slice(10 + length)) };
}
