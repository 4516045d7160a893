// Shows splats in a page of its own. The data are an .spz file of version 3 (see spz.py) in base64, which the GPU
// decodes; a worker sorts the splats by depth, and they are blended from the farthest to the nearest. Ellipsoids are
// projected as in 3DGS, section 4; discs are met by the ray of each pixel, as in 2DGS, section 4.2: to first order, as
// ellipsoids are, a large disc would spread over pixels that it is far from.
"use strict";

const NEAR = 0.05; // in units of the page, of which the scene takes 64
const ROW = 1024; // splats in a row of the texture, two texels each
const facts = JSON.parse(document.getElementById("facts").textContent);
const told = document.getElementById("told");
const canvas = document.querySelector("canvas");

const VERTEX = `#version 300 es
#define REACH 3.3290429691304455
#define EDGE_ON 0.002
precision highp float;
precision highp int;
uniform highp usampler2D splats;
uniform mat3 turn; // from the page to the camera: x right, y down, z forward
uniform vec3 eye;
uniform vec2 size; // of the picture, pixels
uniform float focal; // pixels
uniform float grain; // between positions
uniform bool dims; // opacity by what the blur adds to the footprint
uniform bool discs;
layout(location = 0) in vec2 corner;
layout(location = 1) in uint index;
out vec4 color;
out vec3 place; // in a splat: xy / z, in standard deviations
out vec2 away; // pixels from the middle of the blur of a disc

float part(uint word) {
  return ((word & 512u) != 0u ? -1.0 : 1.0) * float(word & 511u) / 511.0 * 0.7071067811865476;
}

mat3 rotation(uint word) {
  vec3 three = vec3(part(word >> 20), part(word >> 10), part(word));
  float most = sqrt(max(0.0, 1.0 - dot(three, three)));
  uint largest = word >> 30;
  vec4 q = largest == 0u ? vec4(most, three) : largest == 1u ? vec4(three.x, most, three.yz)
    : largest == 2u ? vec4(three.xy, most, three.z) : vec4(three, most);
  float x = q.x, y = q.y, z = q.z, w = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec4 bytes(uint word) {
  return vec4(float(word & 255u), float(word >> 8 & 255u), float(word >> 16 & 255u), float(word >> 24));
}

// Where the rim of a disc, k standard deviations from its centre, lies on the screen: middle and half sides of its box.
// axes: u and v, as long as a standard deviation, and the centre, camera frame; the rim must lie ahead of the camera.
vec4 rim(mat3 axes, float k) {
  vec3 weights = vec3(k * k, k * k, -1.0);
  mat3 rows = transpose(axes);
  float depth = dot(weights * rows[2], rows[2]);
  vec2 middle = vec2(dot(weights * rows[0], rows[2]), dot(weights * rows[1], rows[2])) / depth;
  vec2 square = vec2(dot(weights * rows[0], rows[0]), dot(weights * rows[1], rows[1])) / depth;
  return focal * vec4(middle, sqrt(max(middle * middle - square, 0.0)));
}

// Places the corner of a disc; false where it is not drawn.
bool disc(mat3 axes, float opacity, out vec2 pixel) {
  vec2 slopes = vec2(axes[0].z, axes[1].z);
  if (REACH * length(slopes) >= axes[2].z) return false;
  float k = min(sqrt(2.0 * log(255.0 * opacity)), REACH);
  vec4 box = rim(axes, k);
  vec2 blurred = rim(axes, 3.0).xy;
  vec2 half_sides = max(box.zw, abs(box.xy - blurred) + k * 0.7071067811865476);
  pixel = box.xy + corner * half_sides;
  away = pixel - blurred;
  vec3 ray = vec3(pixel / focal, 1.0), across = cross(axes[0], axes[1]);
  // By Cramer's rule, and linear on the screen.
  place = vec3(dot(cross(axes[1], axes[2]), ray), dot(cross(axes[2], axes[0]), ray), dot(across, ray));
  bool edge_on = abs(dot(across, axes[2])) < EDGE_ON * length(across) * length(axes[2]);
  if (edge_on) place = vec3(1.0, 1.0, 0.0); // infinitely far: the blur alone is drawn
  return true;
}

// Places the corner of an ellipsoid; false where it is not drawn.
bool ellipsoid(mat3 axes, vec3 scales, vec3 there, inout float opacity, out vec2 pixel) {
  vec2 reach = 0.65 * size / focal; // beyond the picture, the projection is that at its border
  vec2 ray = clamp(there.xy / there.z, -reach, reach);
  float zoom = focal / there.z;
  vec3 right = zoom * (vec3(axes[0].x, axes[1].x, axes[2].x) - ray.x * vec3(axes[0].z, axes[1].z, axes[2].z)) * scales;
  vec3 down = zoom * (vec3(axes[0].y, axes[1].y, axes[2].y) - ray.y * vec3(axes[0].z, axes[1].z, axes[2].z)) * scales;
  float a = dot(right, right), b = dot(right, down), c = dot(down, down);
  float sharp = a * c - b * b;
  a += 0.3;
  c += 0.3;
  opacity *= (dims ? sqrt(max(sharp, 0.0) / (a * c - b * b)) : 1.0);
  if (opacity < 1.0 / 255.0) return false;
  float middle = 0.5 * (a + c), apart = length(vec2(0.5 * (a - c), b));
  float longer = middle + apart, shorter = max(middle - apart, 0.05);
  vec2 along = apart < 1e-6 * middle ? vec2(1.0, 0.0)
    : normalize(a > c ? vec2(longer - c, b) : vec2(b, longer - a));
  vec2 sigmas = corner * sqrt(2.0 * log(255.0 * opacity));
  vec2 shift = sigmas.x * sqrt(longer) * along + sigmas.y * sqrt(shorter) * vec2(-along.y, along.x);
  pixel = focal * there.xy / there.z + shift;
  place = vec3(sigmas, 1.0);
  away = vec2(0.0);
  return true;
}

void main() {
  ivec2 at = ivec2(int(index % ${ROW}u) * 2, int(index / ${ROW}u));
  uvec4 first = texelFetch(splats, at, 0), second = texelFetch(splats, at + ivec2(1, 0), 0);
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside: not drawn
  vec3 mean = vec3(ivec3(first.xyz)) * grain;
  vec3 there = turn * (mean - eye);
  if (there.z < ${NEAR}) return;
  vec4 shade = bytes(first.w) / 255.0;
  vec3 scales = exp(bytes(second.y).xyz / 16.0 - 10.0);

  mat3 axes = turn * rotation(second.x);
  vec2 pixel;
  float opacity = shade.a;
  if (discs) {
    if (opacity < 1.0 / 255.0 || !disc(mat3(axes[0] * scales.x, axes[1] * scales.y, there), opacity, pixel)) return;
  } else if (!ellipsoid(axes, scales, there, opacity, pixel)) return;
  gl_Position = vec4(2.0 * pixel.x / size.x, -2.0 * pixel.y / size.y, 0.0, 1.0);

  vec3 way = normalize(mean - eye);
  vec4 low = bytes(second.z), high = bytes(second.w);
  vec3 y = (low.xyz - 128.0) / 128.0, z = (vec3(low.w, high.xy) - 128.0) / 128.0;
  vec3 x = (vec3(high.zw, float(second.y >> 24)) - 128.0) / 128.0;
  vec3 seen = 0.5 + 0.28209479177387814 * (shade.rgb - 0.5) / 0.15
    + 0.4886025119029199 * (way.z * z - way.y * y - way.x * x);
  color = vec4(max(seen, 0.0), opacity);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform bool discs;
in vec4 color;
in vec3 place;
in vec2 away;
out vec4 pixel;
void main() {
  float square = dot(place.xy, place.xy) / (place.z * place.z);
  float blur = 2.0 * dot(away, away);
  if (discs && !(square <= blur)) square = blur;
  float alpha = min(color.a * exp(-0.5 * square), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(color.rgb * alpha, alpha);
}`;

// The worker: indices of the splats in front of the camera, the farthest first, by counting their depths. The bits of a
// positive float32 are in the order of its value; as many of them are counted as there are bins for.
function sorter() {
  const BINS = 1 << 20;
  let xyz;
  onmessage = ({ data }) => {
    if (data.xyz) { xyz = data.xyz; return; }
    const [x, y, z] = data.forward, offset = data.offset, near = data.near, count = xyz.length / 3;
    const depths = new Float32Array(count), keys = new Int32Array(depths.buffer);
    let least = 0x7fffffff, most = 0, found = 0;
    for (let i = 0; i < count; i++) {
      depths[i] = x * xyz[3 * i] + y * xyz[3 * i + 1] + z * xyz[3 * i + 2] - offset;
      if (!(depths[i] >= near)) continue;
      found++;
      if (keys[i] < least) least = keys[i];
      if (keys[i] > most) most = keys[i];
    }
    const order = new Uint32Array(found);
    if (found) {
      let shift = 0;
      while ((most - least) >> shift >= BINS) shift++;
      const starts = new Uint32Array(((most - least) >> shift) + 2);
      for (let i = 0; i < count; i++) if (depths[i] >= near) starts[((most - keys[i]) >> shift) + 1]++;
      for (let bin = 1; bin < starts.length; bin++) starts[bin] += starts[bin - 1];
      for (let i = 0; i < count; i++) if (depths[i] >= near) order[starts[(most - keys[i]) >> shift]++] = i;
    }
    postMessage(order, [order.buffer]);
  };
}

async function unpacked(text) {
  const letters = atob(text), packed = new Uint8Array(letters.length);
  for (let i = 0; i < packed.length; i++) packed[i] = letters.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Texels (8 words a splat) and positions of the bytes of an .spz file.
function decoded(data) {
  const head = new DataView(data.buffer, 0, 16), count = head.getUint32(8, true), degree = head.getUint8(12);
  const grain = 2 ** -head.getUint8(13), dims = (head.getUint8(14) & 1) === 1, kept = 3 * ((degree + 1) ** 2 - 1);
  const means = 16, alphas = means + 9 * count, colors = alphas + count, scales = colors + 3 * count;
  const turns = scales + 3 * count, rest = turns + 4 * count;
  const words = new Int32Array(8 * ROW * Math.max(1, Math.ceil(count / ROW))), xyz = new Float32Array(3 * count);
  const word = (a, b, c, d) => a | (b << 8) | (c << 16) | (d << 24);
  for (let i = 0; i < count; i++) {
    for (let axis = 0; axis < 3; axis++) {
      const at = means + 9 * i + 3 * axis;
      words[8 * i + axis] = (word(0, data[at], data[at + 1], data[at + 2])) >> 8;
      xyz[3 * i + axis] = words[8 * i + axis] * grain;
    }
    const color = colors + 3 * i, scale = scales + 3 * i, turn = turns + 4 * i;
    const sh = (k) => (degree ? data[rest + kept * i + k] : 128);
    words[8 * i + 3] = word(data[color], data[color + 1], data[color + 2], data[alphas + i]);
    words[8 * i + 4] = word(data[turn], data[turn + 1], data[turn + 2], data[turn + 3]);
    words[8 * i + 5] = word(data[scale], data[scale + 1], data[scale + 2], sh(8));
    words[8 * i + 6] = word(sh(0), sh(1), sh(2), sh(3));
    words[8 * i + 7] = word(sh(4), sh(5), sh(6), sh(7));
  }
  return { count, grain, dims, xyz, words: new Uint32Array(words.buffer) };
}

// ---- vectors and matrices: three numbers, and nine by rows

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, by = 1) => a.map((value, i) => value + by * b[i]);
const rows = (m) => [m.slice(0, 3), m.slice(3, 6), m.slice(6, 9)];
const times = (m, v) => rows(m).map((row) => dot(row, v));
const product = (m, n) => rows(m).flatMap((row) => [0, 1, 2].map((j) => dot(row, [n[j], n[j + 3], n[j + 6]])));

function about(axis, angle) { // Rodrigues
  const [x, y, z] = axis, c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
  return [c + x * x * d, x * y * d - z * s, x * z * d + y * s, y * x * d + z * s, c + y * y * d, y * z * d - x * s,
    z * x * d - y * s, z * y * d + x * s, c + z * z * d];
}

// ---- the camera: where it stands, how it is turned, and how far ahead lies what it turns about

const camera = { eye: [0, 0, 0], turn: [], away: 1, focal: 1, aspect: 1, view: 0 };

function stand(at) {
  camera.view = (at + facts.views.length) % facts.views.length;
  const view = facts.views[camera.view];
  Object.assign(camera, { eye: [...view.eye], turn: [...view.turn], away: view.away, focal: view.focal, aspect: view.aspect });
  tell();
}

function tell() {
  if (document.body.dataset.state !== "drawn") return; // "loading ..." stays
  told.textContent = [facts.title, facts.told, facts.views[camera.view].name].filter(Boolean).join(" - ");
}

const middle = () => plus(camera.eye, rows(camera.turn)[2], camera.away);

function orbit(across, down) {
  const centre = middle();
  const whole = product(about(facts.up, across), about(rows(camera.turn)[0], down));
  camera.eye = plus(centre, times(whole, plus(camera.eye, centre, -1)));
  const back = [0, 3, 6, 1, 4, 7, 2, 5, 8].map((i) => whole[i]);
  camera.turn = product(camera.turn, back);
}

function move(right, down, ahead) {
  const [x, y, z] = rows(camera.turn);
  camera.eye = plus(plus(plus(camera.eye, x, right), y, down), z, ahead);
}

function approach(factor) {
  const away = camera.away * factor;
  move(0, 0, camera.away - away);
  camera.away = away;
}

// ---- drawing

function program(gl) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

async function main() {
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
  if (!gl || !window.DecompressionStream) throw new Error("this browser is too old: WebGL 2 and DecompressionStream are needed");
  const source = document.getElementById("splats");
  const splats = decoded(await unpacked(source.textContent));
  source.remove();
  const used = program(gl), uniform = (name) => gl.getUniformLocation(used, name);
  gl.useProgram(used);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  const height = splats.words.length / (8 * ROW);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, 2 * ROW, height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, splats.words);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.enableVertexAttribArray(1);
  gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(1, 1);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  gl.clearColor(0, 0, 0, 1);
  gl.uniform1f(uniform("grain"), splats.grain);
  gl.uniform1i(uniform("dims"), splats.dims ? 1 : 0);
  gl.uniform1i(uniform("discs"), facts.discs ? 1 : 0);
  const places = Object.fromEntries(["turn", "eye", "size", "focal"].map((name) => [name, uniform(name)]));

  const worker = new Worker(URL.createObjectURL(new Blob([`(${sorter})()`], { type: "text/javascript" })));
  const xyz = splats.xyz;
  worker.postMessage({ xyz });
  let drawn = 0, isSorting = false, isStale = true, isWaiting = false;

  function focalPixels() { // all of the photograph is in the picture
    return camera.focal * Math.min(canvas.height, canvas.width / camera.aspect);
  }

  function sort() {
    if (isSorting || !isStale) return;
    isSorting = true;
    isStale = false;
    const forward = rows(camera.turn)[2];
    worker.postMessage({ forward, offset: dot(forward, camera.eye), near: NEAR });
  }

  function draw() {
    isWaiting = false;
    const density = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * density)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(places.turn, true, camera.turn);
    gl.uniform3fv(places.eye, camera.eye);
    gl.uniform2f(places.size, width, height);
    gl.uniform1f(places.focal, focalPixels());
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, drawn);
  }

  function ask() {
    if (!isWaiting) requestAnimationFrame(draw);
    isWaiting = true;
  }

  function changed() {
    isStale = true;
    sort();
    ask();
  }

  worker.onmessage = ({ data }) => {
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    drawn = data.length;
    isSorting = false;
    draw();
    if (document.body.dataset.state !== "drawn") {
      document.body.dataset.state = "drawn";
      tell();
    }
    sort();
  };

  // What lies under a place of the canvas: the nearest splat whose centre is within some pixels of it.
  function under(left, top) {
    const [right, down, forward] = rows(camera.turn), focal = focalPixels(), by = canvas.width / canvas.clientWidth;
    const [x, y] = [left * by - canvas.width / 2, top * by - canvas.height / 2];
    let best = Infinity, found = null;
    for (let i = 0; i < splats.count; i++) {
      const from = [xyz[3 * i] - camera.eye[0], xyz[3 * i + 1] - camera.eye[1], xyz[3 * i + 2] - camera.eye[2]];
      const depth = dot(from, forward);
      if (depth < NEAR || depth > best || splats.words[8 * i + 3] >>> 24 < 128) continue;
      if (Math.hypot((focal * dot(from, right)) / depth - x, (focal * dot(from, down)) / depth - y) > 6 * by) continue;
      best = depth;
      found = plus(camera.eye, from);
    }
    return found;
  }

  listen(changed, under);
  stand(facts.start);
  changed();
}

// ---- mouse, fingers and keys

function listen(changed, under) {
  const pointers = new Map();
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, wide: Math.hypot(a.x - b.x, a.y - b.y) || 1 };
  };
  const pixel = () => camera.away / (camera.focal * Math.min(canvas.clientHeight, canvas.clientWidth / camera.aspect));
  const pan = (x, y) => move(-x * pixel(), -y * pixel(), 0);
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const x = event.clientX - last.x, y = event.clientY - last.y, before = pointers.size === 2 ? spread() : null;
    Object.assign(last, { x: event.clientX, y: event.clientY });
    if (before) {
      const after = spread();
      pan(after.x - before.x, after.y - before.y);
      approach(before.wide / after.wide);
    } else if (event.buttons & 2 || event.shiftKey) pan(x, y);
    else if (pointers.size === 1) orbit(-turned(x), -turned(y));
    changed();
  });
  const turned = (pixels) => (pixels * Math.PI) / Math.min(canvas.clientWidth, canvas.clientHeight);
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    approach(Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * (event.deltaMode ? 0.05 : 0.0015)))));
    changed();
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", (event) => {
    const found = under(event.offsetX, event.offsetY);
    if (!found) return;
    const [right, down, forward] = rows(camera.turn), way = plus(found, camera.eye, -1);
    camera.away = dot(way, forward); // the place comes to lie in the middle
    move(dot(way, right), dot(way, down), 0);
    changed();
  });
  const help = document.getElementById("help"), toggle = () => { help.hidden = !help.hidden; };
  document.getElementById("more").addEventListener("click", toggle);
  const walk = (right, down, ahead) => () => move(...[right, down, ahead].map((by) => 0.05 * by * camera.away));
  const keys = {
    ArrowLeft: () => orbit(-0.05, 0), ArrowRight: () => orbit(0.05, 0), ArrowUp: () => orbit(0, -0.05),
    ArrowDown: () => orbit(0, 0.05), "+": () => approach(0.9), "=": () => approach(0.9), "-": () => approach(1 / 0.9),
    w: walk(0, 0, 1), s: walk(0, 0, -1), a: walk(-1, 0, 0), d: walk(1, 0, 0), q: walk(0, 1, 0), e: walk(0, -1, 0),
    n: () => stand(camera.view + 1), p: () => stand(camera.view - 1), r: () => stand(facts.start), h: toggle,
    f: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()),
  };
  window.addEventListener("keydown", (event) => {
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
    changed();
  });
  window.addEventListener("resize", changed);
}

main().catch((error) => { told.textContent = `The splats cannot be shown: ${error.message}`; });
