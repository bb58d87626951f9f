// Helpers for tests of shared pages in any browser: pages of Playwright and of Puppeteer.

import assert from "node:assert/strict";
import { join } from "node:path";
import { PNG } from "pngjs";
import { OUT, psnr, renderFrom } from "./harness.js";

export const SIZE = { width: 640, height: 360 };

/** Collects the page's errors, and the addresses that it requests. */
export function watch(page) {
  const problems = [];
  const asked = [];
  page.on("pageerror", (error) => problems.push(String(error)));
  page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
  page.on("request", (request) => /^(data|blob):/.test(request.url()) || asked.push(request.url()));
  return { problems, asked };
}

/** In the page: whether its final picture is drawn. */
export const isSettled = () => {
  const renderer = /** @type {any} */ (window).irradia?.renderer;
  return renderer && renderer.total > 0 && renderer.loaded === renderer.total && renderer.sharp && !renderer.busy && renderer.drawn > 0;
};

/** The page's picture. */
export async function shown(page) {
  const address = await page.evaluate(() => {
    // WebGPU's canvas is empty after the browser has composed it.
    /** @type {any} */ (window).irradia.renderer.painter.present();
    return document.querySelector("canvas").toDataURL("image/png");
  });
  return PNG.sync.read(Buffer.from(address.split(",")[1], "base64"));
}

/** The program's picture from the page's camera. */
export const rendered = async (page, scene, size = SIZE) =>
  renderFrom(await page.evaluate(() => /** @type {any} */ (window).irradia.camera()), scene, size);

/** Asserts that the page looks as the program draws it, before and after a drag and `zoom`; `settled` waits for its final picture. Returns
 * the first PSNR, and writes a screenshot. */
export async function looksAsDrawn(page, scene, screenshot, { settled, zoom }) {
  const first = await shown(page);
  const db = psnr(first, await rendered(page, scene));
  assert.ok(db >= 35, `${db} dB`);
  await page.screenshot({ path: join(OUT, screenshot) });
  await page.mouse.move(300, 180);
  await page.mouse.down();
  await page.mouse.move(420, 200, { steps: 5 });
  await page.mouse.up();
  const camera = () => page.evaluate(() => JSON.stringify(/** @type {any} */ (window).irradia.camera()));
  const dragged = await camera();
  await zoom();
  // The page may receive the wheel event later than the browser.
  const end = Date.now() + 120000;
  while ((await camera()) === dragged) {
    assert.ok(Date.now() < end, "the page never saw the wheel");
    await new Promise((resolve) => setTimeout(resolve, 20));
  }
  await settled();
  const second = await shown(page);
  assert.ok(psnr(first, second) < 30, "the drag did not change the picture");
  const turned = psnr(second, await rendered(page, scene));
  assert.ok(turned >= 35, `${turned} dB after the drag`);
  return db;
}
