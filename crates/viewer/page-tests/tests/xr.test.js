// Virtual reality, as far as a browser without a headset allows: a simulated session replaces that of a headset.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { browse, serve, set, sharp, stopAll, until } from "./harness.js";
import { trained } from "./scenes.js";

/** @type {import("playwright-core").Browser} */
let browser;
before(async () => (browser = await browse("webgl")));
after(async () => {
  stopAll();
  await browser.close();
});

/** Simulates a headset: two eyes of half the canvas each, 20 cm apart, that look in the page's direction. */
function headset() {
  const eye = (/** @type {number} */ x) => ({ transform: { matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, 0, 0, 1] }, projectionMatrix: new Float32Array([1.5, 0, 0, 0, 0, 1.5, 0, 0, 0, 0, -1, -1, 0, 0, -0.1, 0]) });
  const views = [eye(-0.1), eye(0.1)];
  const session = Object.assign(new EventTarget(), {
    frames: 0,
    updateRenderState() {},
    requestReferenceSpace: async () => ({}),
    requestAnimationFrame(/** @type {Function} */ draw) {
      if (session.frames === 4) return;
      session.frames += 1;
      setTimeout(() => draw(0, { getViewerPose: () => ({ views }) }), 50);
    },
  });
  Object.assign(globalThis, {
    headsetSession: session,
    XRWebGLLayer: class {
      framebuffer = null;
      constructor(/** @type {any} */ _session, /** @type {WebGL2RenderingContext} */ gl) {
        this.gl = gl;
      }
      getViewport(/** @type {any} */ view) {
        const [width, height] = [this.gl.drawingBufferWidth / 2, this.gl.drawingBufferHeight];
        return { x: view === views[0] ? 0 : width, y: 0, width, height };
      }
    },
  });
  Object.defineProperty(navigator, "xr", { value: { isSessionSupported: async () => true, requestSession: async () => session } });
  Object.assign(WebGL2RenderingContext.prototype, { makeXRCompatible: async () => {} });
}

test("a session begins where one is offered, and both eyes see the scene", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const page = await (await browser.newContext({ viewport: { width: 900, height: 500 } })).newPage();
  await page.addInitScript(headset);
  await page.goto(server.address);
  await sharp(page);
  await set(page, { drawing: "local" });
  await sharp(page);
  await page.evaluate(() => (document.querySelector("irr-stage").local.draw = () => false));
  await page.getByRole("button", { name: "VR" }).click();
  await until(page, () => globalThis.headsetSession.frames === 4);
  await page.waitForTimeout(500);
  const [left, right, between] = await page.evaluate(() => {
    const { gl } = document.querySelector("irr-stage").local.webGl;
    const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    const pixels = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    const half = Math.floor(width / 2);
    const [sums, difference] = [[0, 0], { sum: 0 }];
    for (let y = 0; y < height; y += 1) {
      for (let x = 0; x < half; x += 1) {
        const [a, b] = [pixels[4 * (y * width + x) + 1], pixels[4 * (y * width + x + half) + 1]];
        sums[0] += a;
        sums[1] += b;
        difference.sum += Math.abs(a - b);
      }
    }
    return [...sums, difference.sum].map((sum) => sum / (half * height));
  });
  // Both eyes show something of the same brightness, from different positions.
  assert.ok(left > 10 && Math.abs(left / right - 1) < 0.2, `${left} ${right}`);
  assert.ok(between > 0.5 && between < left, `${between}`);
  await page.evaluate(() => globalThis.headsetSession.dispatchEvent(new Event("end")));
  await until(page, async () => document.querySelector("irr-stage").local.wanted.camera === (await import("/page/js/state.js")).state.get("camera"), null, 20);
  await server.stop();
});

test("a headset gets the splats of a page that the server draws", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const page = await (await browser.newContext({ viewport: { width: 900, height: 500 } })).newPage();
  await page.addInitScript(headset);
  await page.goto(server.address);
  await set(page, { drawing: "served" });
  await sharp(page);
  await page.getByRole("button", { name: "VR" }).click();
  await until(page, () => {
    const { loaded, total } = document.querySelector("irr-stage").local;
    return total > 0 && loaded === total;
  }, null, 30);
  await server.stop();
});

test("there is no button where none is offered", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const page = await (await browser.newContext()).newPage();
  await page.addInitScript(() => Object.defineProperty(navigator, "xr", { value: undefined }));
  await page.goto(server.address);
  await sharp(page);
  assert.equal(await page.getByRole("button", { name: "VR" }).count(), 0);
  await server.stop();
});
