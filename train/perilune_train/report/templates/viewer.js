"use strict";
(function () {
  const element = (id) => document.getElementById(id);
  const root = document.documentElement;

  const theme = element("theme");
  const dark = () =>
    root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  const nameTheme = () => { theme.textContent = dark() ? "Light colours" : "Dark colours"; };
  theme.addEventListener("click", () => { root.dataset.theme = dark() ? "light" : "dark"; nameTheme(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", nameTheme);
  theme.hidden = false;
  nameTheme();

  // Print the content of closed parts too, such as the settings of every run.
  const closed = () => document.querySelectorAll("details:not([open])");
  let opened = [];
  addEventListener("beforeprint", () => { opened = [...closed()]; opened.forEach((part) => { part.open = true; }); });
  addEventListener("afterprint", () => { opened.forEach((part) => { part.open = false; }); });

  // Open the closed part that contains the target of a link.
  function reveal() {
    let inside = element(decodeURIComponent(location.hash.slice(1)));
    const target = inside;
    for (; inside; inside = inside.parentElement) if (inside.tagName === "DETAILS") inside.open = true;
    if (target) target.scrollIntoView();
  }
  addEventListener("hashchange", reveal);
  if (location.hash) reveal();

  const block = element("frames-data");
  if (!block) return;
  const { frames, masks } = JSON.parse(block.textContent);
  const stage = element("stage"), picture = element("frame"), mask = element("mask");
  const slider = element("place"), gate = element("block"), opacity = element("opacity");
  const SVG = "http://www.w3.org/2000/svg";

  function shape(tag, kind, attributes) {
    const node = document.createElementNS(SVG, tag);
    node.setAttribute("class", kind);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    return node;
  }
  const ellipse = ([kind, cx, cy, rx, ry, degrees]) =>
    shape("ellipse", kind, { cx, cy, rx, ry, transform: `rotate(${degrees} ${cx} ${cy})` });
  const box = ([kind, x, y, width, height]) => shape("rect", kind, { x, y, width, height });

  function show() {
    const place = Number(slider.value), frame = frames[place];
    picture.src = frame.image;
    picture.alt = `Frame ${frame.name}`;
    const text = `Frame ${place + 1} of ${frames.length}: ${frame.about} (${frame.name})`;
    element("about").textContent = text;
    slider.setAttribute("aria-valuetext", text);
    stage.querySelector(".labels").replaceChildren(...frame.labels.map(ellipse));
    stage.querySelector(".detections").replaceChildren(...frame.detections.map(box));
    stage.classList.toggle("hide-labels", !element("labels").checked);
    stage.classList.toggle("hide-detections", !element("detections").checked);
    const chosen = gate && gate.value !== "" ? masks[Number(gate.value)] : null;
    const image = chosen ? chosen.images[place] : "";
    mask.hidden = !image;
    if (gate) element("scale").hidden = !image;
    if (!image) return;
    mask.src = image;
    mask.alt = `Attention mask ${chosen.block}`;
    mask.style.opacity = Number(opacity.value) / 100;
    element("low").textContent = `${chosen.block}: ${chosen.low.toFixed(2)}`;
    element("high").textContent = chosen.high.toFixed(2);
  }

  function step(by) {
    slider.value = Number(slider.value) + by;
    show();
  }
  function toggle(id) {
    element(id).checked = !element(id).checked;
    show();
  }
  let lastGate = "0";
  function toggleMask() {
    if (!gate) return;
    if (gate.value !== "") lastGate = gate.value;
    gate.value = gate.value === "" ? lastGate : "";
    show();
  }

  for (const control of [slider, gate, opacity, element("labels"), element("detections")]) {
    if (control) control.addEventListener("input", show);
  }
  element("previous").addEventListener("click", () => step(-1));
  element("next").addEventListener("click", () => step(1));
  const keys = {
    ArrowLeft: () => step(-1), ArrowRight: () => step(1),
    l: () => toggle("labels"), d: () => toggle("detections"), m: toggleMask,
  };
  addEventListener("keydown", (event) => {
    // Sliders, lists and scrollable areas use some of these keys themselves.
    const handlesKeys = event.target.matches("select, input[type=range]") || event.target.closest("[tabindex]");
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in keys)) return;
    if (handlesKeys && (event.key.startsWith("Arrow") || event.target === gate)) return;
    keys[event.key]();
    event.preventDefault();
  });
  document.querySelectorAll(".controls[hidden]").forEach((controls) => { controls.hidden = false; });
  show();
})();
