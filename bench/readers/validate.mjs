// Runs the glTF validator of Khronos: node validate.mjs FILE...; prints one JSON list of messages for each file.
// Version 2.0.0-dev.3.10 does not know KHR_gaussian_splatting and takes each attribute name with its prefix for an
// error; these, and the notice that an extension is unknown, are left out. Everything else counts.
import fs from "node:fs";
import path from "node:path";
import validator from "gltf-validator";

const LEVELS = ["error", "warning", "info", "hint"];
const forgiven = (m) => m.code === "UNSUPPORTED_EXTENSION" || (m.code === "MESH_PRIMITIVE_INVALID_ATTRIBUTE"
  && /\/attributes\/KHR_gaussian_splatting:/.test(m.pointer));

const all = {};
for (const file of process.argv.slice(2)) {
  const options = { maxIssues: 0, externalResourceFunction: async (uri) =>
    new Uint8Array(fs.readFileSync(path.join(path.dirname(file), decodeURIComponent(uri)))) };
  try {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)), options);
    all[file] = report.issues.messages.filter((m) => !forgiven(m))
      .map((m) => ({ level: LEVELS[m.severity], code: m.code, message: m.message, at: m.pointer ?? "" }));
  } catch (error) {
    all[file] = [{ level: "error", code: "NOT_GLTF", message: String(error), at: "" }];
  }
}
process.stdout.write(JSON.stringify(all) + "\n");
