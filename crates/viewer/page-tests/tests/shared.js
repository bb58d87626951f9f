// What tests of shared pages have in common, whatever the browser.

import { mkdirSync, readdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { PNG } from "pngjs";
import { readPng, run, scratch } from "./harness.js";

export const SIZE = { width: 640, height: 360 };

/** In the page: whether its final picture is drawn. */
export const isSettled = () => {
  const renderer = /** @type {any} */ (window).irradia?.renderer;
  return renderer && renderer.total > 0 && renderer.loaded === renderer.total && renderer.sharp && !renderer.busy && renderer.drawn > 0;
};

/** The page's picture. @param {{ evaluate: (run: () => Promise<string>) => Promise<string> }} page */
export async function shown(page) {
  const address = await page.evaluate(async () => {
    // WebGPU's canvas is empty once the browser has composed it.
    /** @type {any} */ (window).irradia.renderer.painter.present();
    return document.querySelector("canvas").toDataURL("image/png");
  });
  return PNG.sync.read(Buffer.from(address.split(",")[1], "base64"));
}

let frames = 0;

/** The program's picture of the page's camera. */
export async function rendered(page, scene, { width, height } = SIZE) {
  const camera = await page.evaluate(() => /** @type {any} */ (window).irradia.camera());
  const file = join(scratch, "shared_camera.json");
  writeFileSync(file, JSON.stringify({ irradia_path: 1, fps: 30, loop: false, ease: false, closing: 0, keys: [{ time: 0, ...camera }] }));
  const out = join(scratch, `shared_${(frames += 1)}`);
  mkdirSync(out);
  run("render", scene, "--path", file, "--size", `${width}x${height}`, "--out", out);
  return readPng(join(out, readdirSync(out)[0]));
}
