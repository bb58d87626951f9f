// Measures a frame drawn by the page beside one drawn by Spark and by PlayCanvas (the engine of SuperSplat's viewer), with the same file,
// cameras and browser: npm run bench-peers -- [splats]. The peers are not dependencies:
// npm install --no-save @sparkjsdev/spark@2.2.0 three@0.187.0 playcanvas@2.23.3

import { createReadStream, existsSync, statSync } from "node:fs";
import { createServer } from "node:http";
import { join } from "node:path";
import { browse, open, serve, set } from "./tests/harness.js";
import { random } from "./tests/scenes.js";

const SPLATS = Number(process.argv[2] ?? 500_000);
const [WIDTH, HEIGHT] = [640, 400];
const FRAMES = 12;
/** Vertical field of view, degrees. */
const FOV = 50;
const DISTANCE = 5;
const modules = process.env.PEERS ?? join(import.meta.dirname, "node_modules");
const say = (name, values) => {
  const sorted = [...values].sort((a, b) => a - b);
  console.log(`${name.padEnd(40)} ${sorted[Math.floor(sorted.length / 2)].toFixed(0)} ms a frame (${sorted[0].toFixed(0)} to ${sorted.at(-1)?.toFixed(0)})`);
};

const file = random(SPLATS);
const spark = `<script type="importmap">{"imports":{"three":"/modules/three/build/three.module.js","three/addons/":"/modules/three/examples/jsm/","@sparkjsdev/spark":"/modules/@sparkjsdev/spark/dist/spark.module.js"}}</script>
<body style="margin:0"><script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
const renderer = new THREE.WebGLRenderer({ antialias: false });
renderer.setPixelRatio(1);
renderer.setSize(${WIDTH}, ${HEIGHT});
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(${FOV}, ${WIDTH / HEIGHT}, 0.01, 100);
scene.add(new SparkRenderer({ renderer }));
const mesh = new SplatMesh({ url: "/scene.ply", lod: false });
scene.add(mesh);
await mesh.initialized;
const gl = renderer.getContext();
globalThis.frame = async (angle) => {
  camera.position.set(${DISTANCE} * Math.sin(angle), 0, ${DISTANCE} * Math.cos(angle));
  camera.lookAt(0, 0, 0);
  const started = performance.now();
  renderer.render(scene, camera);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  const spent = performance.now() - started;
  // Sorting continues in a worker.
  await new Promise((resolve) => setTimeout(resolve, 400));
  return spent;
};
globalThis.ready = true;
</script>`;
const playcanvas = `<script type="importmap">{"imports":{"playcanvas":"/modules/playcanvas/build/playcanvas.mjs"}}</script>
<body style="margin:0"><canvas id="c" width="${WIDTH}" height="${HEIGHT}"></canvas><script type="module">
import * as pc from "playcanvas";
const canvas = document.getElementById("c");
const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false, alpha: false } });
app.setCanvasFillMode(pc.FILLMODE_NONE, ${WIDTH}, ${HEIGHT});
app.graphicsDevice.maxPixelRatio = 1;
app.autoRender = false;
app.start();
const asset = new pc.Asset("scene", "gsplat", { url: "/scene.ply" });
app.assets.add(asset);
await new Promise((resolve, reject) => { asset.ready(resolve); asset.on("error", reject); app.assets.load(asset); });
const splats = new pc.Entity();
splats.addComponent("gsplat", { asset });
app.root.addChild(splats);
const camera = new pc.Entity();
camera.addComponent("camera", { fov: ${FOV}, nearClip: 0.01, farClip: 100, clearColor: new pc.Color(0, 0, 0) });
app.root.addChild(camera);
const gl = app.graphicsDevice.gl;
globalThis.frame = (angle) => new Promise((resolve) => {
  camera.setPosition(${DISTANCE} * Math.sin(angle), 0, ${DISTANCE} * Math.cos(angle));
  camera.lookAt(0, 0, 0);
  let started = 0;
  app.once("prerender", () => (started = performance.now()));
  app.once("frameend", async () => {
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    const spent = performance.now() - started;
    await new Promise((done) => setTimeout(done, 400));
    resolve(spent);
  });
  app.renderNextFrame = true;
});
globalThis.ready = true;
</script>`;

const types = { js: "text/javascript", mjs: "text/javascript", wasm: "application/wasm", html: "text/html" };
const http = createServer((request, response) => {
  const path = decodeURIComponent(new URL(request.url ?? "/", "http://x").pathname);
  const page = { "/spark": spark, "/playcanvas": playcanvas }[path];
  if (page) return response.setHeader("content-type", "text/html").end(page);
  const at = path === "/scene.ply" ? file : join(modules, path.replace(/^\/modules\//, ""));
  if (!existsSync(at) || !statSync(at).isFile()) return response.writeHead(404).end();
  response.setHeader("content-type", types[at.split(".").at(-1) ?? ""] ?? "application/octet-stream");
  createReadStream(at).pipe(response);
});
await new Promise((resolve) => http.listen(0, "127.0.0.1", () => resolve(null)));
const { port } = /** @type {import("node:net").AddressInfo} */ (http.address());

const browser = await browse("webgl");
const angles = Array.from({ length: FRAMES }, (_, i) => 0.1 * i);

async function peer(name) {
  const page = await browser.newPage({ viewport: { width: WIDTH, height: HEIGHT } });
  page.on("pageerror", (error) => console.log(`${name}: ${error.message}`));
  await page.goto(`http://127.0.0.1:${port}/${name}`);
  await page.waitForFunction(() => globalThis.ready, null, { timeout: 120000 });
  const times = [];
  for (const angle of [0, 0, 0, ...angles]) times.push(await page.evaluate((angle) => globalThis.frame(angle), angle));
  if (process.env.PEERS_OUT) await page.screenshot({ path: join(process.env.PEERS_OUT, `${name}.png`) });
  await page.close();
  return times.slice(3);
}

async function ours() {
  const server = await serve("view", file, "--port", "0");
  const { page } = await open(browser, server.address, { width: 1000, height: 700 });
  await set(page, { drawing: "local" });
  // The peers draw with WebGL2.
  await page.waitForFunction(() => document.querySelector("irr-stage").local.holdWebGl(true) !== null);
  await page.waitForFunction(() => {
    const { local } = document.querySelector("irr-stage");
    return local.total > 0 && local.loaded === local.total && local.sharp;
  }, null, { timeout: 120000 });
  const times = await page.evaluate(async ({ angles, width, height, fov, distance }) => {
    const { local } = document.querySelector("irr-stage");
    const shot = local.wanted.shot;
    const focal = height / 2 / Math.tan((fov * Math.PI) / 360);
    const k = { width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2 };
    const times = [];
    for (const angle of angles) {
      // Camera axes: x right, y down, z forward, around the y axis.
      const camera = { position: [distance * Math.sin(angle), 0, distance * Math.cos(angle)], rotation: [0, Math.cos(angle / 2), 0, -Math.sin(angle / 2)] };
      // Not through the page's own loop, which chooses its own size.
      local.draw = () => false;
      local.want(camera, k, shot);
      while (local.busy) await new Promise((resolve) => setTimeout(resolve, 5));
      const started = performance.now();
      // Measured: it reads a pixel back, which waits for the picture.
      local.webGl.paint(camera, k, local.options(shot, true));
      times.push(performance.now() - started);
      await new Promise((resolve) => setTimeout(resolve, 400));
    }
    return times;
  }, { angles, width: WIDTH, height: HEIGHT, fov: FOV, distance: DISTANCE });
  if (process.env.PEERS_OUT) await page.screenshot({ path: join(process.env.PEERS_OUT, "ours.png") });
  await page.close();
  await server.stop();
  return times;
}

console.log(`${SPLATS} splats of degree 3, ${WIDTH} x ${HEIGHT}, no GPU`);
say("Irradia", await ours());
for (const [name, folder] of [["spark", "@sparkjsdev/spark"], ["playcanvas", "playcanvas"]]) {
  if (existsSync(join(modules, folder))) say(name, await peer(name));
  else console.log(`${name} is not installed: see the first lines of this file`);
}
await browser.close();
http.close();
