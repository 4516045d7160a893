// Draws files in web viewers, in Chromium without a window: node view.mjs SHOTS.json
// SHOTS: {"chromium": path, "folder": of the files, "shots": [{"viewer": page, "file": name, "camera": {matrix (camera to
// world, column-major, OpenGL axes), fov, near, far}, "width", "height", "out": .png}]}. Prints what each page says.
import fs from "node:fs";
import http from "node:http";
import path from "node:path";
import { fileURLToPath } from "node:url";
import puppeteer from "puppeteer-core";

const here = path.dirname(fileURLToPath(import.meta.url));
const { chromium, folder, shots } = JSON.parse(fs.readFileSync(process.argv[2], "utf8"));
const ROOTS = { pages: path.join(here, "pages"), modules: path.join(here, "node_modules"), files: path.resolve(folder) };
const TYPES = { ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript", ".json": "application/json",
  ".wasm": "application/wasm", ".css": "text/css", ".glb": "model/gltf-binary", ".webp": "image/webp" };

const server = http.createServer((request, response) => {
  const [, root, ...rest] = decodeURIComponent(new URL(request.url, "http://x").pathname).split("/");
  if (root === "favicon.ico") { response.writeHead(204).end(); return; }
  const base = ROOTS[root], file = base && path.join(base, ...rest);
  if (!file || !file.startsWith(base) || !fs.existsSync(file) || fs.statSync(file).isDirectory()) { response.writeHead(404).end(); return; }
  response.writeHead(200, { "content-type": TYPES[path.extname(file)] ?? "application/octet-stream", "content-length": fs.statSync(file).size });
  fs.createReadStream(file).pipe(response);
});
await new Promise((done) => server.listen(0, "127.0.0.1", done));
const site = `http://127.0.0.1:${server.address().port}`;

const browser = await puppeteer.launch({ executablePath: chromium, headless: true, args: ["--no-sandbox", "--use-gl=angle",
  "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--disable-dev-shm-usage", "--hide-scrollbars"] });
const answers = [];
for (const shot of shots) {
  const page = await browser.newPage(), said = [];
  page.on("console", (m) => { if (["error", "warn"].includes(m.type())) said.push(`${m.type()}: ${m.text()}`); });
  page.on("pageerror", (e) => said.push(`error: ${e.message ?? e}`));
  try {
    await page.setViewport({ width: shot.width, height: shot.height, deviceScaleFactor: 1 });
    await page.goto(`${site}/pages/${shot.viewer}.html`, { waitUntil: "load" });
    await page.waitForFunction("window.ready", { timeout: 60000 });
    const job = page.evaluate((s) => window.draw(s), { ...shot, file: `/files/${shot.file}`, site });
    const limit = new Promise((_, fail) => setTimeout(() => fail(new Error("no picture within 120 s")), 120000));
    const answer = await Promise.race([job, limit]);
    await page.screenshot({ path: shot.out });
    answers.push({ ...answer, said: [...new Set(said)] });
  } catch (error) {
    answers.push({ error: String(error.message ?? error), said: [...new Set(said)] });
  }
  await page.close();
}
await browser.close();
server.close();
process.stdout.write(JSON.stringify(answers) + "\n");
