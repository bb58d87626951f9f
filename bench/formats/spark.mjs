// Checks that Spark reads what irradia writes: npm install; node spark.mjs IRRADIA SCENE.ply
//
// Spark needs a browser: every file is opened by its SplatMesh in a headless Chromium (CHROMIUM names another one) and compared with
// the scene splat by splat.

import { execFileSync } from "node:child_process";
import { existsSync, mkdtempSync, readFileSync, rmSync } from "node:fs";
import { createServer } from "node:http";
import { tmpdir } from "node:os";
import { basename, dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { chromium } from "playwright-core";
import { compare, readPly } from "./compare.mjs";

const [irradia, scene] = process.argv.slice(2);
if (!scene) {
  console.error("usage: node spark.mjs IRRADIA SCENE.ply");
  process.exit(2);
}
const modules = process.env.NODE_MODULES ?? join(dirname(fileURLToPath(import.meta.url)), "node_modules");
const folder = mkdtempSync(join(tmpdir(), "irradia-spark-"));
const imports = { three: "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/", "@sparkjsdev/spark": "/@sparkjsdev/spark/dist/spark.module.js" };
const page = `<!doctype html><script type="importmap">${JSON.stringify({ imports })}</script>`;
const server = createServer(({ url }, response) => {
  const path = url.startsWith("/files/") ? join(folder, basename(url)) : join(modules, url);
  if (url === "/") response.writeHead(200, { "content-type": "text/html" }).end(page);
  else if (!existsSync(path)) response.writeHead(404).end();
  else response.writeHead(200, { "content-type": /\.m?js$/.test(path) ? "text/javascript" : "application/octet-stream" }).end(readFileSync(path));
});
await new Promise((ready) => server.listen(0, "127.0.0.1", ready));
const address = `http://127.0.0.1:${server.address().port}`;
const candidates = [process.env.CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"];
const browser = await chromium.launch({
  executablePath: candidates.find((path) => path && existsSync(path)),
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
});

/** Fourteen numbers a splat, as Spark holds them: position, sizes, rotation (x, y, z, w), opacity, colour. */
async function open(name) {
  const tab = await browser.newPage();
  try {
    await tab.goto(address);
    const numbers = await tab.evaluate(async (url) => {
      const { SplatMesh } = await import("@sparkjsdev/spark");
      // Not the packed form, since its rounding would be measured too.
      const mesh = new SplatMesh({ url, extSplats: true });
      await mesh.initialized;
      const all = [];
      mesh.forEachSplat((_, p, s, q, opacity, color) => all.push(p.x, p.y, p.z, s.x, s.y, s.z, q.x, q.y, q.z, q.w, opacity, color.r, color.g, color.b));
      return all;
    }, `/files/${name}`);
    return numbers;
  } finally {
    await tab.close();
  }
}

const SH_C0 = 0.28209479177387814;
const logit = (v) => Math.log(Math.max(v, 1e-6) / Math.max(1 - v, 1e-6));

/** These numbers as columns of a PLY. Spark leaves SPZ in its own axes: y and z are flipped. */
function columnsOf(numbers, flip) {
  const count = numbers.length / 14;
  const column = (at, of = (v) => v) => Float32Array.from({ length: count }, (_, i) => of(numbers[14 * i + at]));
  const names = { x: [0], y: [1, (v) => flip * v], z: [2, (v) => flip * v], opacity: [10, logit] };
  for (const k of [0, 1, 2]) {
    names[`scale_${k}`] = [3 + k, Math.log];
    names[`f_dc_${k}`] = [11 + k, (v) => (v - 0.5) / SH_C0];
  }
  return { count, columns: Object.fromEntries(Object.entries(names).map(([name, args]) => [name, column(...args)])) };
}

const plain = join(folder, "plain.ply");
execFileSync(irradia, ["convert", scene, plain]);
const truth = readPly(plain);
// Without version 4 of SPZ: Spark 2.2 mistakes its zstd for gzip.
const kinds = [["a.ply"], ["a.compressed.ply"], ["a.spz"], ["a.splat"], ["a.ksplat"], ["b.ksplat", "--quality", "high"], ["c.ksplat", "--quality", "low"], ["a.sog"]];
let failed = 0;
console.log("written by irradia, read by Spark; mean difference (largest)");
for (const [name, ...options] of kinds) {
  try {
    execFileSync(irradia, ["convert", plain, join(folder, name), "--no-compare", ...options]);
    const flip = name.endsWith(".spz") ? -1 : 1;
    console.log(`${name.slice(1)} ${options.join(" ")}: ${compare(truth, columnsOf(await open(name), flip))}`);
  } catch (error) {
    failed += 1;
    console.log(`${name.slice(1)} ${options.join(" ")}: FAILED ${error.message.split("\n")[0]}`);
  }
}
await browser.close();
server.close();
rmSync(folder, { recursive: true });
process.exit(failed ? 1 : 0);
