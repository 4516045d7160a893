"use strict";
(() => {
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  const make = (tag, facts) => Object.assign(document.createElement(tag), facts);
  const shortly = (value) => Number(value.toPrecision(4)).toLocaleString("en", { maximumSignificantDigits: 4 });

  // Light or dark: as the system has it until the reader chooses; remembered where the browser allows it.
  const root = document.documentElement, theme = document.getElementById("theme");
  const system = matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => (root.dataset.theme || (system.matches ? "dark" : "light")) === "dark";
  const remember = (action) => { try { return action(localStorage); } catch { return null; } };
  const name = () => { theme.textContent = isDark() ? "Light colours" : "Dark colours"; };
  const chosen = remember((store) => store.getItem("surfkit-report-theme"));
  if (chosen === "dark" || chosen === "light") root.dataset.theme = chosen;
  theme.hidden = false;
  theme.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    remember((store) => store.setItem("surfkit-report-theme", root.dataset.theme));
    name();
  });
  system.addEventListener("change", name);
  name();

  // A table is sorted by the column whose head is pressed, once more turns it round; cells without a number come last.
  const key = (row, at) => {
    const cell = row.cells[at];
    return "value" in cell.dataset ? Number(cell.dataset.value) : null;
  };
  const order = (at, sign) => (a, b) => {
    const [left, right] = [key(a, at), key(b, at)];
    if (left !== null && right !== null) return sign * (left - right);
    if (left !== null || right !== null) return left !== null ? -1 : 1;
    return sign * a.cells[at].textContent.localeCompare(b.cells[at].textContent);
  };
  for (const table of all("table.sortable")) {
    const heads = all("thead th", table), body = table.tBodies[0];
    heads.forEach((head, at) => {
      const button = make("button", { type: "button", textContent: head.textContent });
      head.replaceChildren(button);
      button.addEventListener("click", () => {
        const turned = head.ariaSort === "ascending" ? "descending" : "ascending";
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.ariaSort = turned;
        body.append(...[...body.rows].sort(order(at, turned === "ascending" ? 1 : -1)));
      });
    });
  }

  // A table that is wider than the page can be reached and scrolled by keyboard.
  const reach = () => all(".scroll").forEach((box) => {
    const isWide = box.scrollWidth > box.clientWidth;
    for (const [name, value] of [["tabindex", "0"], ["role", "region"], ["aria-label", box.dataset.label]])
      isWide ? box.setAttribute(name, value) : box.removeAttribute(name);
  });
  addEventListener("resize", reach);
  all("details").forEach((box) => box.addEventListener("toggle", reach));
  reach();

  // Two pictures of a view over each other; the border is moved by the slider below, by arrow keys, or by a finger.
  const select = (label, layers, at) => {
    const chooser = make("select", {});
    layers.forEach((layer, i) => chooser.append(new Option(layer.dataset.label, i, i === at, i === at)));
    const shown = make("label", { textContent: label });
    shown.append(chooser);
    return [shown, chooser];
  };
  for (const figure of all("figure.compare")) {
    const layers = all(".layer", figure), slider = figure.querySelector("input"), stage = figure.querySelector(".stage");
    const move = () => stage.style.setProperty("--cut", slider.value + "%");
    const sides = (left, right) => layers.forEach((layer, i) => {
      layer.classList.toggle("left", i === left);
      layer.classList.toggle("right", i === right);
    });
    figure.classList.add("sliding");
    slider.hidden = false;
    if (layers.length > 2) {
      const [left, first] = select("left", layers, 0), [right, second] = select("right", layers, 1);
      const update = () => sides(Number(first.value), Number(second.value));
      const row = make("div", { className: "sides" });
      row.append(left, right);
      figure.append(row);
      [first, second].forEach((chooser) => chooser.addEventListener("change", update));
    }
    const drag = (event) => {
      if (event.buttons !== 1) return;
      const box = stage.getBoundingClientRect();
      slider.value = 100 * (event.clientX - box.left) / box.width;
      move();
    };
    stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); drag(event); });
    stage.addEventListener("pointermove", drag);
    stage.addEventListener("dragstart", (event) => event.preventDefault());
    slider.addEventListener("input", move);
    sides(0, 1);
    move();
  }

  // The cursor of a chart: a slider below it; the legend says what every line has there.
  const nearest = (steps, step) => steps.reduce((best, one, i) => (Math.abs(one - step) < Math.abs(steps[best] - step) ? i : best), 0);
  for (const figure of all("figure.chart")) {
    const data = JSON.parse(figure.dataset.chart), slider = figure.querySelector("input");
    const cursor = figure.querySelector(".cursor"), outputs = all("output", figure);
    slider.hidden = false;
    slider.addEventListener("input", () => {
      const step = data.steps[Number(slider.value)];
      cursor.hidden = false;
      cursor.style.left = 13 + 84 * step / data.right + "%";
      slider.setAttribute("aria-valuetext", `${data.label} ${shortly(step)}`);
      data.lines.forEach(([steps, values], i) => {
        const at = nearest(steps, step);
        outputs[i].textContent = `${shortly(values[at])} at ${shortly(steps[at])}`;
      });
    });
  }
})();
