// A line with the coordinates under the pointer. The server knows them (cursor.py); this asks it while the pointer moves.
(() => {
  "use strict";
  const EVERY_MS = 100; // between two requests, at least
  const AGAIN_MS = 5000; // after one that failed: the server may have ended
  const line = document.createElement("div");
  line.id = "surfkit-coordinates";
  Object.assign(line.style, {
    position: "fixed", zIndex: "1", display: "none", pointerEvents: "none",
    padding: "0.15em 0.5em", borderRadius: "0.3em",
    font: "13px/1.5 ui-monospace, monospace", color: "#fff", background: "rgba(0, 0, 0, 0.65)",
    whiteSpace: "nowrap", overflow: "hidden", textOverflow: "ellipsis", boxSizing: "border-box",
  });
  document.body.append(line);

  let at = null; // where the pointer is, and on which canvas; null elsewhere and while a button is pressed
  let due = false; // pointer or camera have moved since the last request
  let busy = false;
  let earliest = 0; // of the next request, milliseconds of performance.now()
  let client = "", turn = ""; // as the server has written them into the panel

  function show(text) {
    line.textContent = text;
    line.style.display = text ? "block" : "none";
    if (!text || !at) return;
    line.style.left = `${at.box.left + 8}px`;
    line.style.bottom = `${window.innerHeight - at.box.bottom + 8}px`;
    line.style.maxWidth = `${at.box.width - 16}px`;
  }

  // The middle of a pixel from the middle of the canvas, in halves of its height.
  function placed(event) {
    const canvas = event.target;
    if (!(canvas instanceof HTMLCanvasElement) || event.buttons !== 0 || event.pointerType === "touch") return null;
    const box = canvas.getBoundingClientRect();
    const half = canvas.clientHeight / 2;
    const x = (event.clientX - box.left + 0.5 - canvas.clientWidth / 2) / half;
    const y = (event.clientY - box.top + 0.5) / half - 1;
    return Math.abs(y) <= 1 && Math.abs(x) * half <= canvas.clientWidth / 2 ? { x, y, box } : null;
  }

  function follow(event) {
    at = placed(event);
    due = at !== null;
    if (!due) show("");
  }

  function leave() {
    at = null;
    show("");
  }

  async function ask() {
    due = false;
    busy = true;
    const began = performance.now();
    try {
      const query = new URLSearchParams({ client, x: at.x, y: at.y });
      const answer = await fetch(`surfkit/ask?${query}`, { cache: "no-store" });
      const text = answer.ok ? await answer.text() : "";
      show(at && client ? text : "");
      const now = performance.now();
      earliest = now + Math.max(EVERY_MS - (now - began), now - began); // the server rests as long as it works
    } catch {
      show("");
      earliest = performance.now() + AGAIN_MS;
    }
    busy = false;
  }

  function look() {
    const tag = document.getElementById("surfkit-cursor"); // not there while the panel is folded: then as before
    if (tag && (tag.dataset.client !== client || tag.dataset.turn !== turn)) {
      ({ client, turn } = tag.dataset);
      due = at !== null;
      if (!client) show("");
    }
    if (due && at && client && !busy && performance.now() >= earliest) ask();
  }

  for (const kind of ["pointermove", "pointerdown", "pointerup", "pointercancel"]) {
    window.addEventListener(kind, follow, { capture: true, passive: true });
  }
  for (const kind of ["wheel", "keydown"]) { // also while the panel is folded, or when the server has ended
    window.addEventListener(kind, () => { due = at !== null; }, { capture: true, passive: true });
  }
  document.documentElement.addEventListener("pointerleave", leave);
  setInterval(look, EVERY_MS / 4);
})();
