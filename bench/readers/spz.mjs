// Reads a .spz file with the official library (Niantic and Adobe, WebAssembly) into float32 columns:
//   node spz.mjs FILE OUT AXES      AXES as the library names them: RDF is that of PLY, UNSPECIFIED as stored
// OUT holds positions 3N, log scales 3N, quaternions wxyz 4N, opacity logits N, f_dc 3N, f_rest (red, green, blue).
// Or makes one from such columns: node spz.mjs --write FILE OUT AXES VERSION DEGREE
import fs from "node:fs";
import create from "@adobe/spz";

const floats = (path) => { const b = fs.readFileSync(path); return new Float32Array(b.buffer, b.byteOffset, b.length / 4); };
console.log = console.info = () => {};  // the library reports on standard output, where our answer goes
const library = await create({ print: () => {}, printErr: () => {} });

function read(file, out, axes) {
  const cloud = library.loadSpzFromBuffer(fs.readFileSync(file), { to: library.CoordinateSystem[axes] });
  const n = cloud.numPoints, rest = n ? cloud.sh.length / n : 0;
  const quats = new Float32Array(4 * n), sh = new Float32Array(rest * n);
  for (let i = 0; i < n; i++) {
    for (let j = 0; j < 4; j++) quats[4 * i + ((j + 1) % 4)] = cloud.rotations[4 * i + j];
    for (let k = 0; k < rest / 3; k++) for (let c = 0; c < 3; c++)
      sh[rest * i + c * (rest / 3) + k] = cloud.sh[rest * i + 3 * k + c];
  }
  const parts = [cloud.positions, cloud.scales, quats, cloud.alphas, cloud.colors, sh];
  fs.writeFileSync(out, Buffer.concat(parts.map((p) => Buffer.from(p.buffer, p.byteOffset, p.byteLength))));
  return { points: n, degree: cloud.shDegree, antialiased: Boolean(cloud.antialiased) };
}

function write(file, out, axes, version, degree) {
  const all = floats(file), rest = [0, 9, 24, 45][degree], n = all.length / (14 + rest);
  let at = 0;
  const take = (width) => all.slice(at, (at += width * n));
  const [positions, scales, wxyz, alphas, colors, planes] = [3, 3, 4, 1, 3, rest].map(take);
  const rotations = new Float32Array(4 * n), sh = new Float32Array(rest * n);
  for (let i = 0; i < n; i++) {
    for (let j = 0; j < 4; j++) rotations[4 * i + j] = wxyz[4 * i + ((j + 1) % 4)];
    for (let k = 0; k < rest / 3; k++) for (let c = 0; c < 3; c++)
      sh[rest * i + 3 * k + c] = planes[rest * i + c * (rest / 3) + k];
  }
  const cloud = { numPoints: n, shDegree: degree, antialiased: false, extensions: [], positions, scales, rotations, alphas, colors, sh };
  const options = { version, from: library.CoordinateSystem[axes], sh1Bits: 5, shRestBits: 4 };
  fs.writeFileSync(out, library.saveSpzToBuffer(cloud, options));
  return { points: n, degree };
}

const [first, ...others] = process.argv.slice(2);
const answer = first === "--write" ? write(others[0], others[1], others[2], Number(others[3]), Number(others[4])) : read(first, ...others);
process.stdout.write(JSON.stringify(answer) + "\n");
