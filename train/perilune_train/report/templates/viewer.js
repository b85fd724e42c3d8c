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
  const { frames, masks, answers } = JSON.parse(block.textContent);
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

  // Answers on single detections. Without detections the page has no panel.
  const panel = element("answer");
  const words = { matched: "correct detection", false: "false positive", unjudged: "detection that is not evaluated" };
  let chosen = -1, focusable = 0;
  const here = () => Number(slider.value);
  const answerTo = (frame, detection) =>
    answers.each.find((one) => one.frame === frame && one.detection === detection);
  const nameOf = (mark) => `Score ${mark[5].toFixed(2)}, ${words[mark[0]]}, ${Math.sqrt(mark[3] * mark[4]).toFixed(0)} px wide`;
  const boxes = () => [...stage.querySelectorAll(".detections rect")];

  function button(mark, number) {
    const node = box(mark);
    if (!panel) return node;
    if (answerTo(here(), number)) node.classList.add("answered");
    if (number === chosen) node.classList.add("chosen");
    const name = `Detection ${number + 1} of ${frames[here()].detections.length}: ${nameOf(mark)}`;
    const attributes = { role: "button", "aria-label": name, "aria-pressed": number === chosen };
    // One stop of the Tab key for all detections; arrows lead from one to the next.
    attributes.tabindex = number === focusable ? 0 : -1;
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    return node;
  }

  function paragraphs(id, lines) {
    element(id).replaceChildren(...lines.map((line) => {
      const node = document.createElement("p");
      node.textContent = line;
      return node;
    }));
  }

  function groundOf({ caption, image, box: [x, y, width, height], overlay }) {
    const figure = document.createElement("figure"), ground = document.createElement("div");
    ground.className = "stage";
    for (const [source, name] of [[image, ""], [overlay, "overlay"]]) {
      if (!source) continue;
      const node = new Image();
      node.src = source;
      node.alt = name ? "" : `Ground around the detection, ${caption}`;
      node.className = name;
      ground.append(node);
    }
    const svg = shape("svg", "marks", { viewBox: "0 0 1 1", "aria-hidden": true });
    svg.append(shape("rect", "matched", { x, y, width, height }));
    ground.append(svg);
    const text = document.createElement("figcaption");
    text.textContent = caption;
    figure.append(ground, text);
    return figure;
  }

  function sureOf(mark) {
    const lines = [`Score ${mark[5].toFixed(2)}. ${answers.ofScore}`];
    if (mark.length < 13) {
      const size = `${mark[3].toFixed(1)} x ${mark[4].toFixed(1)} px`;
      return [...lines, `Box: ${size}. This detector predicts no ellipses and no standard deviations.`];
    }
    const [a, b, degrees, ...sigmas] = mark.slice(6), [x, y, major, minor] = sigmas.map((sigma) => sigma.toFixed(2));
    return [
      ...lines,
      `Ellipse: semi-axes ${a.toFixed(1)} and ${b.toFixed(1)} px, direction ${degrees.toFixed(0)}°.`,
      `Standard deviations: centre ${x} and ${y} px, semi-axes ${major} and ${minor} px.`,
    ];
  }

  function close() {
    if (!panel || chosen < 0) return;
    chosen = -1;
    panel.hidden = true;
    boxes().forEach((node) => { node.classList.remove("chosen"); node.setAttribute("aria-pressed", false); });
  }

  function ask(number) {
    close();
    chosen = number;
    focusOn(number, false);
    const mark = frames[here()].detections[number], answer = answerTo(here(), number), node = boxes()[number];
    node.classList.add("chosen");
    node.setAttribute("aria-pressed", true);
    element("answer-title").textContent = `Detection ${number + 1}: ${nameOf(mark)}`;
    element("answer-pictures").replaceChildren(...(answer ? answer.pictures : []).map(groundOf));
    paragraphs("answer-why", answer ? answer.why : ["Not computed for this detection. " + answers.chosen]);
    paragraphs("answer-sure", sureOf(mark));
    paragraphs("answer-position", answer ? answer.position : ["Not computed for this detection."]);
    panel.hidden = false;
    panel.focus({ preventScroll: true });
    panel.scrollIntoView({ block: "nearest" });
  }

  function focusOn(number, move = true) {
    const all = boxes();
    if (!all.length) return;
    all[Math.min(focusable, all.length - 1)].setAttribute("tabindex", -1);
    focusable = Math.max(0, Math.min(number, all.length - 1));
    all[focusable].setAttribute("tabindex", 0);
    if (move) all[focusable].focus();
  }

  // The smallest box around the place of the click, or the box whose centre is nearest if none contains it.
  function detectionAt(event) {
    if (!element("detections").checked) return -1;
    const area = stage.getBoundingClientRect(), frame = frames[here()];
    const scale = frame.width / area.width, near = 16 * scale;
    const u = (event.clientX - area.left) * scale, v = (event.clientY - area.top) * scale;
    let best = -1, least = Infinity;
    frame.detections.forEach(([, x, y, width, height], number) => {
      const inside = u >= x && u <= x + width && v >= y && v <= y + height;
      const apart = Math.hypot(u - x - width / 2, v - y - height / 2);
      const cost = inside ? width * height : 1e9 + apart;
      if ((inside || apart <= near) && cost < least) [best, least] = [number, cost];
    });
    return best;
  }

  function nextAnswer() {
    const all = [...answers.each].sort((one, two) => one.frame - two.frame || one.detection - two.detection);
    const after = (one) => one.frame > here() || (one.frame === here() && one.detection > chosen);
    const next = all.find(after) || all[0];
    if (next.frame !== here()) { slider.value = next.frame; show(); }
    element("detections").checked = true;
    stage.classList.remove("hide-detections");
    ask(next.detection);
  }

  let lastPlace = 0;
  function show() {
    const place = Number(slider.value), frame = frames[place];
    if (place !== lastPlace) { close(); focusable = 0; lastPlace = place; }
    picture.src = frame.image;
    picture.alt = `Frame ${frame.name}`;
    const text = `Frame ${place + 1} of ${frames.length}: ${frame.about} (${frame.name})`;
    element("about").textContent = text;
    slider.setAttribute("aria-valuetext", text);
    stage.querySelector(".labels").replaceChildren(...frame.labels.map(ellipse));
    stage.querySelector(".detections").replaceChildren(...frame.detections.map(button));
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
  if (panel) {
    const svg = stage.querySelector(".marks"), again = element("next-answer");
    svg.removeAttribute("aria-hidden");
    svg.setAttribute("role", "group");
    svg.setAttribute("aria-label", "Detections");
    stage.classList.add("asks");
    element("ask").hidden = false;
    stage.addEventListener("click", (event) => {
      const number = detectionAt(event);
      if (number >= 0) ask(number);
    });
    const back = () => { const number = chosen; close(); focusOn(number); };
    element("close-answer").addEventListener("click", back);
    panel.addEventListener("keydown", (event) => { if (event.key === "Escape") back(); });
    const moves = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1, Home: -Infinity, End: Infinity };
    svg.addEventListener("keydown", (event) => {
      if (event.key === "Enter" || event.key === " ") ask(focusable);
      else if (event.key in moves) focusOn(focusable + moves[event.key]);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
    if (again) {
      again.addEventListener("click", nextAnswer);
      keys.a = nextAnswer;
    }
  }
  addEventListener("keydown", (event) => {
    // Sliders, lists and scrollable areas use some of these keys themselves.
    const handlesKeys = event.target.matches("select, input[type=range]") || event.target.closest("[tabindex='0']");
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in keys)) return;
    if (handlesKeys && (event.key.startsWith("Arrow") || event.target === gate)) return;
    keys[event.key]();
    event.preventDefault();
  });
  document.querySelectorAll(".controls[hidden]").forEach((controls) => { controls.hidden = false; });
  show();
})();
