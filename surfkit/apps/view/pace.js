// How long this browser takes for its pictures. The server draws less in one that is slow (pace.py).
(() => {
  "use strict";
  const LOOK_MS = 100; // between two looks for what there is to tell
  const EVERY_MS = 500; // between two requests, at least
  const AGAIN_MS = 5000; // after one that failed: the server may have ended
  const LAST = 10; // pictures are told, those before are not
  const IDLE_MS = 500; // after which a picture is a single one: nothing moves
  const NEW_MS = 500; // for which pictures wait for what was sent
  const COUNTED = 1000; // things in a draw call; those with fewer are marks and lines
  const CALLS = [["drawArrays", 2], ["drawElements", 1], ["drawArraysInstanced", 3], ["drawElementsInstanced", 4]];
  const waiting = []; // pictures that the machine still computes
  let picture = null; // whose draw calls are being made
  let last = -Infinity; // end of the picture before, milliseconds of performance.now()
  let times = [], drawn = "", since = 0; // of pictures with the same things, not yet told; when the first of them ended
  let told = "", busy = false, earliest = 0;

  for (const [name, place] of CALLS) {
    const plain = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...given) {
      if (!picture) {
        picture = { gl: this, began: performance.now(), counts: new Set() };
        queueMicrotask(end); // after the last draw call
      }
      if (given[place] >= COUNTED) picture.counts.add(given[place]);
      return plain.apply(this, given);
    };
  }

  // Draw calls return at once; this becomes known as done when the picture is.
  function end() {
    picture.fence = picture.gl.fenceSync(picture.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    waiting.push(picture);
    picture = null;
    if (waiting.length === 1) setTimeout(look);
  }

  function look() {
    const done = [];
    while (waiting.length && !isOpen(waiting[0])) done.push(waiting.shift());
    const now = performance.now();
    for (const { began, counts } of done) {
      const time = (now - Math.max(done[0].began, last)) / done.length;
      const things = [...counts].sort().join(",");
      const belongs = things && began - last < IDLE_MS && began - since > NEW_MS;
      if (things !== drawn) [times, drawn, since] = [[], things, now];
      else if (belongs) times = [...times, Math.round(time)].slice(-LAST);
    }
    if (done.length) last = now;
    if (waiting.length) setTimeout(look, 4);
  }

  function isOpen({ gl, fence }) {
    const open = fence && gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.UNSIGNALED;
    if (!open) gl.deleteSync(fence);
    return open;
  }

  function isSoftware() {
    const gl = document.createElement("canvas").getContext("webgl2");
    const names = gl?.getExtension("WEBGL_debug_renderer_info");
    const name = gl?.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
  }
  const software = isSoftware() ? 1 : 0;

  async function tell() {
    const tag = document.getElementById("surfkit-pace"); // not there while the panel is folded: then as before
    const client = tag ? tag.dataset.client : told;
    if (busy || !client || (client === told && !times.length) || performance.now() < earliest) return;
    busy = true;
    const query = new URLSearchParams({ client, software, ms: times.join(","), drawn });
    times = [];
    const answer = await fetch(`surfkit/pace?${query}`, { cache: "no-store" }).catch(() => null);
    if (answer?.ok) told = client;
    earliest = performance.now() + (answer?.ok ? EVERY_MS : AGAIN_MS);
    busy = false;
  }
  setInterval(tell, LOOK_MS);
})();
