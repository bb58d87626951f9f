// Compares pictures on the page with those that `irradia render` draws from the same camera.

import assert from "node:assert/strict";
import { readdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { browse, get, open, picture, pretendGpu, psnr, readPng, renderFrom, run, scratch, serve, set, sharp, stopAll, until } from "./harness.js";
import { field, fox, random, shiny, trained } from "./scenes.js";

/** One browser shows served pictures, the others draw. @type {Record<"browser" | "drawing" | "computing", import("playwright-core").Browser>} */
let { browser, drawing, computing } = {};
before(async () => ([browser, drawing, computing] = [await browse(), await browse("webgl"), await browse("webgpu")]));
after(async () => {
  stopAll();
  await Promise.all([browser, drawing, computing].map((one) => one.close()));
});

/** The program's picture from the page's camera. */
const rendered = async (page, scene, size) => renderFrom(await get(page, "camera"), scene, size);

/** Drags over the stage. */
async function drag(page, dx, dy) {
  const box = await page.locator("irr-stage .overlay").boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  await page.mouse.move(x, y);
  await page.mouse.down();
  await page.mouse.move(x + dx / 2, y + dy / 2, { steps: 4 });
  await page.mouse.move(x + dx, y + dy, { steps: 4 });
  await page.mouse.up();
  await sharp(page);
}

const SIZE = { width: 560, height: 400 };

test("a drag changes the served picture as the renderer says", async () => {
  const scene = trained();
  const server = await serve("view", scene, "--port", "0");
  const { page, problems } = await open(browser, server.address, SIZE);
  await set(page, { drawing: "served", axes: false });
  await sharp(page);
  const first = await picture(page);
  assert.ok(psnr(first, await rendered(page, scene, first)) >= 38);
  await drag(page, 120, 40);
  const second = await picture(page);
  assert.ok(psnr(first, second) < 30, "the drag did not change the picture");
  const db = psnr(second, await rendered(page, scene, second));
  assert.ok(db >= 38, `${db} dB`);
  assert.deepEqual(problems, []);
  await server.stop();
});

for (const [name, make, least] of [["a field", field, 38], ["splats with a residual field", shiny, 38]]) {
  test(`${name} is served like splats`, async () => {
    const scene = make();
    const server = await serve("view", scene, "--port", "0");
    const { page } = await open(browser, server.address, { width: 200, height: 180 });
    await set(page, { drawing: "local", axes: false });
    await sharp(page);
    assert.equal(await page.evaluate(() => document.querySelector("irr-stage").drawsLocally), false);
    const shown = await picture(page);
    const db = psnr(shown, await rendered(page, scene, shown));
    assert.ok(db >= least, `${db} dB`);
    for (const mode of ["depth"]) {
      await set(page, { mode });
      await sharp(page);
      assert.ok(psnr(shown, await picture(page)) < 25, `${mode} is no other picture`);
    }
    // A field has no splats to count.
    await page.keyboard.press("5");
    assert.equal(await get(page, "mode"), make === field ? "depth" : "count");
    await server.stop();
  });
}

for (const [name, make] of [["a trained scene", trained], ["random splats", () => random(4000)], ["photographs", fox]]) {
  test(`${name} drawn in the browser are those of the renderer`, async (context) => {
    const scene = make();
    if (!scene) return context.skip("SKIPPED (no ../shared)");
    const server = await serve("view", scene, "--port", "0");
    const { page, problems } = await open(drawing, server.address, SIZE);
    await set(page, { drawing: "local", axes: false });
    await sharp(page);
    for (const [dx, dy] of [[0, 0], [150, -30]]) {
      if (dx) await drag(page, dx, dy);
      assert.equal(await page.evaluate(() => document.querySelector("irr-stage").drawsLocally), true);
      const shown = await picture(page);
      const db = psnr(shown, await rendered(page, scene, shown));
      console.log(`${name}: ${db.toFixed(2)} dB`);
      assert.ok(db >= 35, `${db} dB`);
    }
    assert.deepEqual(problems, []);
    await server.stop();
  });
}

test("a moving camera gets a level of detail from afar, here and from the server, one at rest the scene itself", async () => {
  const scene = join(scratch, "detailed.ply");
  run("convert", trained(), scene, "--lod");
  const server = await serve("view", scene, "--port", "0");
  const { page, problems } = await open(drawing, server.address, SIZE);
  await set(page, { drawing: "local", axes: false });
  await sharp(page);
  await until(page, () => {
    const { counts, loaded } = document.querySelector("irr-stage").local.levels;
    return counts.length === 4 && loaded.every((count, i) => count === counts[i]);
  });
  // So far away that a level is dense at every resolution, which depends on the machine's speed. A little farther with every frame.
  const levels = await page.evaluate(async () => {
    const stage = document.querySelector("irr-stage");
    const { state } = await import("/page/js/state.js");
    const { forward } = await import("/page/js/camera.js");
    const seen = new Set();
    const { camera, scene } = { camera: state.get("camera"), scene: state.get("scene") };
    for (let frame = 0; frame < 40; frame += 1) {
      const back = (20 + 0.1 * frame) * scene.radius;
      state.set({ camera: { ...camera, position: camera.position.map((v, c) => v - back * forward(camera)[c]) } });
      await new Promise(requestAnimationFrame);
      seen.add(stage.local.level);
    }
    return [...seen];
  });
  assert.ok(Math.max(...levels) >= 1, `levels ${levels}`);
  await sharp(page);
  assert.equal(await page.evaluate(() => document.querySelector("irr-stage").local.level), 0);
  const shown = await picture(page);
  const db = psnr(shown, await rendered(page, scene, shown));
  assert.ok(db >= 35, `${db} dB`);
  await set(page, { drawing: "served" });
  await sharp(page);
  assert.ok(psnr(shown, await picture(page)) >= 35);
  await drag(page, 60, 0);
  const served = await picture(page);
  assert.ok(psnr(served, await rendered(page, scene, served)) >= 38);
  assert.deepEqual(problems, []);
  await server.stop();
});

/** What paints in the page, and what the panel says about it. */
const painter = (page) => page.evaluate(() => {
  const { api, reason } = document.querySelector("irr-stage").local;
  return { api, reason, text: document.querySelector("irr-display-panel").textContent };
});

/** Small pictures, since WebGPU in software is slow. */
const SMALL = { width: 320, height: 240 };

for (const [name, make] of [["a trained scene", trained], ["random splats", () => random(4000)]]) {
  test(`${name} drawn with WebGPU are those of the renderer, with and without the GPU`, async () => {
    const scene = make();
    const server = await serve("view", scene, "--port", "0");
    const { page, problems } = await open(computing, server.address, { ...SMALL, before: pretendGpu });
    assert.equal(await page.evaluate(() => document.querySelector("irr-stage").drawsLocally), true, "a GPU draws where nothing is said");
    await set(page, { axes: false, sidebar: false });
    const compare = async (/** @type {number} */ least, /** @type {string} */ api) => {
      await sharp(page);
      const [shown, { api: used, text }] = [await picture(page), await painter(page)];
      const db = psnr(shown, await rendered(page, scene, shown));
      console.log(`${name}, ${used}: ${db.toFixed(2)} dB`);
      assert.ok(used === api && text.includes(`here, by ${api}`), `${used}: ${text}`);
      assert.ok(db >= least, `${db} dB`);
      return shown;
    };
    const first = await compare(38, "WebGPU");
    await drag(page, 60, -20);
    const second = await compare(38, "WebGPU");
    assert.ok(psnr(first, second) < 30, "the drag did not change the picture");
    const { center, radius } = await get(page, "scene");
    const corner = (/** @type {number} */ part) => center.map((/** @type {number} */ c) => c + part * radius);
    await set(page, { clip: [corner(-0.3), corner(0.2)] });
    await sharp(page);
    const clipped = await picture(page);
    await set(page, { drawing: "served" });
    await sharp(page);
    assert.ok(psnr(clipped, await picture(page)) >= 35, "clipped here as on the server");
    await set(page, { drawing: "local", clip: null, mode: "ellipses" });
    await sharp(page);
    assert.equal((await painter(page)).api, "WebGL2");
    await set(page, { mode: "color" });
    await sharp(page);
    assert.equal((await painter(page)).api, "WebGPU");
    // A frame that fails after its device was lost.
    await page.evaluate(async () => {
      const { local } = document.querySelector("irr-stage");
      const { gpu } = local;
      gpu.gpu.device.destroy();
      await gpu.gpu.device.lost;
      local.giveUp(gpu, new Error("late"));
    });
    await until(page, () => document.querySelector("irr-stage").local.api === "WebGL2");
    await compare(35, "WebGL2");
    assert.match((await painter(page)).text, /the GPU was lost/);
    assert.deepEqual(problems, []);
    await server.stop();
  });
}

for (const [name, before, reason] of /** @type {const} */ ([
  ["no WebGPU", () => Object.defineProperty(Navigator.prototype, "gpu", { get: () => undefined }), /has no WebGPU/],
  ["no adapter", () => (GPU.prototype.requestAdapter = async () => null), /no GPU/],
  ["a GPU that is software", () => {}, /on the CPU/],
  ["a kernel that does not compile", () => {
    Object.defineProperty(GPUAdapterInfo.prototype, "isFallbackAdapter", { get: () => false });
    Object.defineProperty(GPUAdapterInfo.prototype, "architecture", { get: () => "tested" });
    GPUDevice.prototype.createComputePipelineAsync = async () => { throw new Error("refused"); };
  }, /refused/],
])) {
  test(`with ${name} the page draws with WebGL2 and says why`, async () => {
    const server = await serve("view", random(500), "--port", "0");
    const { page, problems } = await open(computing, server.address, { ...SMALL, before });
    await set(page, { drawing: "local", axes: false });
    await sharp(page);
    const { api, reason: said, text } = await painter(page);
    assert.equal(api, "WebGL2");
    assert.match(said, reason);
    assert.ok(text.includes(said), text);
    assert.deepEqual(problems, []);
    await server.stop();
  });
}

test("where WebGL2 has no shaders the server draws", async () => {
  const server = await serve("view", random(500), "--port", "0");
  const { page } = await open(drawing, server.address, { ...SMALL, before: () => {
    WebGL2RenderingContext.prototype.getShaderParameter = () => false;
    WebGL2RenderingContext.prototype.getShaderInfoLog = () => "refused";
  } });
  await set(page, { drawing: "local" });
  await until(page, () => !document.querySelector("irr-stage").drawsLocally);
  await sharp(page);
  await page.getByText("refused").waitFor();
  await server.stop();
});

test("a comparison ends where its view is left", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page, problems } = await open(drawing, server.address, SMALL);
  const shown = () => page.evaluate(async () => {
    const { frustumAt } = await import("/page/js/overlay.js");
    const stage = document.querySelector("irr-stage");
    const { camera, k } = stage.wanted;
    return { local: stage.drawsLocally, cameras: frustumAt(camera, k, 0, 0, Infinity) !== null };
  });
  await set(page, { drawing: "local", frusta: true });
  assert.deepEqual(await shown(), { local: true, cameras: true });
  await set(page, { view: 3, compare: "error" });
  assert.deepEqual(await shown(), { local: false, cameras: false });
  await set(page, { view: null });
  assert.deepEqual(await shown(), { local: true, cameras: true });
  assert.deepEqual(problems, []);
  await server.stop();
});

test("splats beside a wide picture reach into it as far as the renderer says", async () => {
  // One in the middle, and one that is centred four of its sizes outside, where the projection stretches it.
  const names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split(" ");
  const splat = (/** @type {number} */ x) => [x, 0, 0, 1.5, 1.5, 1.5, 6, ...Array(3).fill(Math.log(0.1)), 1, 0, 0, 0];
  const values = Float32Array.from([0, -1.6].flatMap(splat));
  const properties = names.map((name) => `property float ${name}\n`).join("");
  const header = `ply\nformat binary_little_endian 1.0\nelement vertex 2\n${properties}end_header\n`;
  const scene = join(scratch, "wide.ply");
  writeFileSync(scene, Buffer.concat([Buffer.from(header), Buffer.from(values.buffer)]));
  const server = await serve("view", scene, "--port", "0");
  const { page, problems } = await open(drawing, server.address, { width: 400, height: 300 });
  await set(page, { drawing: "local", axes: false, sidebar: false });
  const aspect = await page.evaluate(() => {
    const { clientWidth, clientHeight } = document.querySelector("irr-stage");
    return clientWidth / clientHeight;
  });
  // The picture ends 1.2 units beside the first splat.
  await set(page, { camera: { position: [0, 0, -1], rotation: [1, 0, 0, 0], fov: 2 * Math.atan(1.2 / aspect) }, view: null });
  await sharp(page);
  const shown = await picture(page);
  const program = await rendered(page, scene, shown);
  const at = (/** @type {import("pngjs").PNG} */ png) => png.data[4 * png.width * Math.floor(png.height / 2)];
  assert.ok(at(program) > 10, `it is not seen: ${at(program)}`);
  assert.ok(Math.abs(at(shown) - at(program)) <= 3, `${at(shown)} instead of ${at(program)}`);
  assert.deepEqual(problems, []);
  await server.stop();
});

test("the page and the program agree about camera paths", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page } = await open(browser, server.address, { width: 300, height: 200 });
  const saved = await page.evaluate(async () => {
    const { path } = await import("/page/js/path.js");
    document.querySelector("irr-path-panel").fromViews();
    path.keys = path.keys.slice(0, 4);
    path.fps = 1;
    return { file: JSON.parse(JSON.stringify(path)), middle: path.at(3) };
  });
  const file = join(scratch, "path.json");
  writeFileSync(file, JSON.stringify(saved.file));
  const out = join(scratch, "film");
  run("render", trained(), "--path", file, "--size", "300x200", "--out", out);
  assert.equal(readdirSync(out).length, 7);
  await set(page, { camera: saved.middle, drawing: "served", axes: false, sidebar: false });
  const box = await page.evaluate(() => [document.querySelector("irr-stage").clientWidth, document.querySelector("irr-stage").clientHeight]);
  run("render", trained(), "--path", file, "--size", `${box[0]}x${box[1]}`, "--out", join(scratch, "film2"));
  await sharp(page);
  const db = psnr(await picture(page), readPng(join(scratch, "film2", readdirSync(join(scratch, "film2"))[3])));
  assert.ok(db >= 38, `${db} dB`);
  await server.stop();
});
