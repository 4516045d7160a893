// Reads the splats of a .glb or .gltf with the GLTFLoader of three.js into float32 columns: node gltf.mjs FILE OUT
// OUT holds positions 3N, linear scales 3N, quaternions xyzw 4N, opacities N, then each SH coefficient 3N (red, green,
// blue), by degree and order. Prints points, degree, the extension object, the node's matrix (column-major) and COLOR_0.
// With KHR_gaussian_splatting_compression_spz_2 the SPZ blob goes to OUT as it is.
import fs from "node:fs";
import path from "node:path";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

globalThis.self ??= globalThis;
globalThis.ProgressEvent ??= class { constructor(type, values) { Object.assign(this, values, { type }); } };
const [file, out] = process.argv.slice(2);
const NAME = "KHR_gaussian_splatting", SPZ = "KHR_gaussian_splatting_compression_spz_2";

function parse() {
  const bytes = fs.readFileSync(file);
  const data = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
  const folder = path.resolve(path.dirname(file));
  const loader = new GLTFLoader();
  // Files beside a .gltf are read from disk: Node's fetch takes no file: addresses.
  loader.manager.setURLModifier((url) => /^(data|blob):/.test(url) ? url
    : "data:application/octet-stream;base64," + fs.readFileSync(path.join(folder, decodeURIComponent(url))).toString("base64"));
  return loader.parseAsync(file.endsWith(".gltf") ? new TextDecoder().decode(data) : data, "");
}

const gltf = await parse();
const json = gltf.parser.json;
const mesh = json.meshes.findIndex((m) => m.primitives.some((p) => p.extensions?.[NAME]));
const primitive = json.meshes[mesh]?.primitives.find((p) => p.extensions?.[NAME]);
if (!primitive) throw new Error(`${file}: no primitive with ${NAME}`);
gltf.scene.updateMatrixWorld(true);
let points;
gltf.scene.traverse((o) => { if (o.isPoints) points ??= o; });
const answer = { extension: primitive.extensions[NAME], mode: primitive.mode, matrix: points.matrixWorld.elements,
  used: json.extensionsUsed ?? [], required: json.extensionsRequired ?? [], attributes: Object.keys(primitive.attributes) };
const names = answer.attributes.filter((n) => /SH_DEGREE_\d_COEF_/.test(n)).sort();
answer.degree = Math.max(0, ...names.map((n) => Number(/SH_DEGREE_(\d)/.exec(n)[1])));
const blob = answer.extension.extensions?.[SPZ];
if (blob) {
  answer.points = json.accessors[primitive.attributes.POSITION].count;
  answer.spz = true;
  fs.writeFileSync(out, Buffer.from(await gltf.parser.getDependency("bufferView", blob.bufferView)));
} else {
  const column = (name) => {
    const attribute = points.geometry.getAttribute(name === "POSITION" ? "position" : name === "COLOR_0" ? "color" : name.toLowerCase());
    if (!attribute) throw new Error(`${file}: three.js gives no attribute ${name}`);
    const { count, itemSize } = attribute, values = new Float32Array(count * itemSize);
    for (let i = 0; i < count; i++) for (let k = 0; k < itemSize; k++) values[i * itemSize + k] = attribute.getComponent(i, k);
    return Buffer.from(values.buffer);
  };
  answer.points = points.geometry.getAttribute("position").count;
  const wanted = ["POSITION", ...["SCALE", "ROTATION", "OPACITY"].map((n) => `${NAME}:${n}`), ...names];
  fs.writeFileSync(out, Buffer.concat(wanted.map(column)));
  if (primitive.attributes.COLOR_0 !== undefined) answer.fallback = Array.from(new Float32Array(column("COLOR_0").buffer.slice(0))).slice(0, 4);
}
process.stdout.write(JSON.stringify(answer) + "\n");
