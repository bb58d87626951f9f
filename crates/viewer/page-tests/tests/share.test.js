// Shared pages: opened from a file without a network, and as a folder from a web server.

import assert from "node:assert/strict";
import { readdirSync, readFileSync, statSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import { after, before, test } from "node:test";
import { browse, OUT, pretendGpu, psnr, run, scratch } from "./harness.js";
import { isSettled, looksAsDrawn, rendered, shown, SIZE, watch } from "./shared.js";
import { random, trained } from "./scenes.js";

/** @type {import("playwright-core").Browser} */
let browser;
before(async () => (browser = await browse("webgl")));
after(() => browser.close());

/** Opens a shared page and waits for its final picture. */
async function open(address, options = {}, { by = browser, before = () => {} } = {}) {
  const context = await by.newContext({ viewport: SIZE, ...options });
  const page = await context.newPage();
  await page.addInitScript(before);
  const { problems, asked } = watch(page);
  await page.goto(address);
  await settled(page, problems);
  return { page, problems, asked };
}

async function settled(page, problems) {
  await page.waitForTimeout(200);
  await page.waitForFunction(isSettled, null, { timeout: 120000 }).catch((error) => {
    throw new Error(`${error.message}; ${problems.join("; ")}`);
  });
}

for (const [name, make] of [["a trained scene", trained], ["random splats", () => random(4000)]]) {
  test(`${name} opens from a file without a network and looks as the program draws it`, async () => {
    const scene = make();
    const html = join(scratch, `${name.replaceAll(" ", "_")}.html`);
    const said = run("share", scene, "-o", html, "--title", "Shared <scene>", "--credits", "somebody");
    assert.match(said, /splats of degree \d, [\d.]+ MB/);
    const { page, problems, asked } = await open(pathToFileURL(html).href, { offline: true });
    const db = await looksAsDrawn(page, scene, `shared_${name.replaceAll(" ", "_")}.png`, {
      settled: () => settled(page, problems),
      zoom: () => page.mouse.wheel(0, -200),
    });
    console.log(`${name}: ${db.toFixed(2)} dB, ${(statSync(html).size / 1e6).toFixed(2)} MB`);
    assert.equal(await page.title(), "Shared <scene>");
    assert.deepEqual(problems, []);
    assert.deepEqual(asked, [pathToFileURL(html).href]);
  });
}

test("a flight plays by itself, ends at a touch and plays again at the press of its button", async () => {
  const html = join(scratch, "flight.html");
  run("convert", random(4000), join(scratch, "plain.html"));
  run("share", random(4000), "-o", html, "--path", "orbit");
  const { page, problems } = await open(pathToFileURL(html).href, { offline: true, reducedMotion: "reduce" });
  const position = () => page.evaluate(() => /** @type {any} */ (window).irradia.camera().position);
  const moves = async () => {
    const before = await position();
    await page.waitForTimeout(400);
    return Math.hypot(...(await position()).map((v, i) => v - before[i])) > 1e-4;
  };
  const button = page.locator("#play");
  assert.equal(await moves(), false, "it plays although little motion is preferred");
  await button.click();
  assert.equal(await moves(), true);
  assert.equal(await button.getAttribute("aria-pressed"), "true");
  await page.screenshot({ path: join(OUT, "shared_flight.png") });
  await page.mouse.click(300, 180);
  assert.equal(await moves(), false, "a touch does not end it");
  assert.equal(await button.textContent(), "Play");
  assert.deepEqual(problems, []);
  const other = await browser.newContext({ viewport: SIZE });
  const opened = await other.newPage();
  await opened.goto(pathToFileURL(html).href);
  await opened.waitForFunction(() => document.getElementById("play")?.getAttribute("aria-pressed") === "true", null, { timeout: 60000 });
  const plain = await other.newPage();
  await plain.goto(pathToFileURL(join(scratch, "plain.html")).href);
  assert.equal(await plain.locator("#play").isVisible(), false);
});

test("a page from a file draws with WebGPU where there is a GPU", async () => {
  const viewport = { width: 320, height: 180 };
  const html = join(scratch, "gpu.html");
  const scene = random(4000);
  run("share", scene, "-o", html);
  const by = await browse("webgpu");
  const { page, problems, asked } = await open(pathToFileURL(html).href, { offline: true, viewport }, { by, before: pretendGpu });
  assert.equal(await page.evaluate(() => /** @type {any} */ (window).irradia.renderer.api), "WebGPU");
  const db = psnr(await shown(page), await rendered(page, scene, viewport));
  console.log(`WebGPU: ${db.toFixed(2)} dB`);
  assert.ok(db >= 38, `${db} dB`);
  assert.deepEqual(problems, []);
  assert.deepEqual(asked, [pathToFileURL(html).href]);
  await by.close();
});

test("a page draws again after its GPU was lost", async () => {
  const html = join(scratch, "lost.html");
  run("share", random(4000), "-o", html);
  const { page, problems } = await open(pathToFileURL(html).href, { offline: true });
  const before = await shown(page);
  await page.evaluate(() => {
    const { renderer } = /** @type {any} */ (window).irradia;
    renderer.webGl.gl.getExtension("WEBGL_lose_context").loseContext();
    return new Promise((resolve) => (renderer.webGl.canvas.addEventListener("webglcontextlost", () => setTimeout(resolve))));
  });
  await settled(page, problems);
  assert.ok(psnr(before, await shown(page)) > 50);
  assert.deepEqual(problems, []);
});

test("a page that is too large loses harmonics, then splats, and says so", async () => {
  const html = join(scratch, "small.html");
  const said = run("share", random(4000), "-o", html, "--max", "150kB");
  assert.match(said, /degree 3 became degree 0/);
  assert.ok(statSync(html).size <= 150000);
});

test("a folder is served with a start picture and its scene beside it", async () => {
  const folder = join(scratch, "site");
  const scene = random(4000);
  run("share", scene, "-o", folder, "--folder");
  assert.deepEqual(readdirSync(folder).sort(), ["index.html", "poster.png", "scene.irs.gz"]);
  const types = { html: "text/html", png: "image/png", gz: "application/octet-stream" };
  const server = createServer((request, response) => {
    const name = request.url === "/" ? "index.html" : request.url.slice(1);
    if (!readdirSync(folder).includes(name)) return response.writeHead(404).end();
    response.writeHead(200, { "content-type": types[name.split(".").pop()] }).end(readFileSync(join(folder, name)));
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  const { page } = await open(`http://127.0.0.1:${server.address().port}/`);
  const db = psnr(await shown(page), await rendered(page, scene));
  assert.ok(db >= 35, `${db} dB`);
  assert.equal(await page.locator(".poster").count(), 0);
  server.close();
});
