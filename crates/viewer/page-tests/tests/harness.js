// Starts the program and a browser, and compares pictures.

import { spawn, execFileSync } from "node:child_process";
import { existsSync, mkdirSync, mkdtempSync, readdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium } from "playwright-core";
import { PNG } from "pngjs";

const root = join(import.meta.dirname, "../../../..");
/** The program under test. */
export const PROGRAM = process.env.IRRADIA ?? join(process.env.CARGO_TARGET_DIR ?? join(root, "target"), "release/irradia");
/** Where screenshots go. */
export const OUT = process.env.PAGE_TESTS_OUT ?? join(import.meta.dirname, "../out");
mkdirSync(OUT, { recursive: true });

export const scratch = mkdtempSync(join(tmpdir(), "irradia-page-"));
process.on("exit", () => rmSync(scratch, { recursive: true, force: true }));

/** Runs the program to its end. @param {...string} args */
export const run = (...args) => execFileSync(PROGRAM, args, { stdio: ["ignore", "pipe", "pipe"], encoding: "utf8" });

/** Programs that are still serving, for example after a failed test. @type {Set<import("node:child_process").ChildProcess>} */
const serving = new Set();
/** Ends all programs that are still serving. */
export const stopAll = () => serving.forEach((child) => child.kill("SIGKILL"));

/** Starts a command that serves a page. @param {...string} args */
export async function serve(...args) {
  const child = spawn(PROGRAM, args, { stdio: ["ignore", "pipe", "pipe"] });
  serving.add(child);
  child.on("exit", () => serving.delete(child));
  const lines = [];
  const address = await new Promise((resolve, reject) => {
    const read = (/** @type {Buffer} */ data) => {
      lines.push(data.toString());
      const found = lines.join("").match(/viewer: (http:\S+)/);
      if (found) resolve(found[1]);
    };
    child.stdout.on("data", read);
    child.stderr.on("data", read);
    child.on("exit", (code) => reject(new Error(`ended with ${code}: ${lines.join("")}`)));
  });
  const ended = new Promise((resolve) => child.on("exit", resolve));
  return {
    address, lines, child, ended,
    async stop(signal = "SIGINT") {
      child.kill(signal);
      await ended;
    },
  };
}

const CHROMIUM = [process.env.CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"].find((path) => path && existsSync(path));

const WEBGL = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];
const WEBGPU = ["--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan", "--use-vulkan=swiftshader", "--disable-gpu-watchdog"];

/** A headless browser; with WebGL or WebGPU it draws everything with a software rasteriser, which is slower.
 * @param {"webgl" | "webgpu" | null} [api] */
export const browse = (api = null) => chromium.launch({
  executablePath: CHROMIUM,
  args: ["--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    ...(api ? [...WEBGL, ...(api === "webgpu" ? WEBGPU : [])] : ["--disable-gpu", "--disable-software-rasterizer"])],
});

/** For `addInitScript`: WebGPU in software claims to be a GPU, since pages do not use WebGPU in software. */
export function pretendGpu() {
  for (const [key, value] of Object.entries({ isFallbackAdapter: false, architecture: "tested" })) Object.defineProperty(GPUAdapterInfo.prototype, key, { get: () => value });
}

/** Opens the page and waits until it shows a sharp picture. @param {import("playwright-core").Browser} browser */
export async function open(browser, address, { width = 1440, height = 900, theme = "dark", density = 1, before = () => {} } = {}) {
  const context = await browser.newContext({ viewport: { width, height }, colorScheme: /** @type {any} */ (theme), deviceScaleFactor: density, reducedMotion: "reduce" });
  const page = await context.newPage();
  await page.addInitScript(before);
  context.setDefaultTimeout(120000);
  const problems = [];
  page.on("pageerror", (error) => problems.push(String(error)));
  page.on("console", (message) => message.type() === "error" && !/WebSocket|ERR_CONNECTION|404/.test(message.text()) && problems.push(message.text()));
  await page.goto(address);
  await sharp(page);
  return { page, problems, context };
}

/** Waits for the final picture of the current camera. */
export async function sharp(page) {
  await page.evaluate(async () => {
    await document.querySelector("irr-stage").local.ready;
    for (let i = 0; i < 2; i += 1) await new Promise(requestAnimationFrame);
  });
  await page.waitForFunction(() => {
    const stage = document.querySelector("irr-stage");
    if (stage.drawsLocally) return stage.local.sharp && stage.local.total > 0 && stage.local.loaded === stage.local.total && !stage.local.busy && !stage.dirty;
    return stage.shown?.header?.sharp && stage.shown.header.id === stage.ids && !stage.dirty;
  }, null, { timeout: 120000 });
}

/** Waits until `holds`, which may be asynchronous, is true in the page. @param {import("playwright-core").Page} page */
export async function until(page, holds, argument = null, seconds = 120) {
  const end = Date.now() + 1000 * seconds;
  while (!(await page.evaluate(holds, argument))) {
    if (Date.now() > end) throw new Error(`it never held: ${holds}`);
    await page.waitForTimeout(50);
  }
}

/** The picture on the stage, without the overlay. */
export async function picture(page) {
  const address = await page.evaluate(() => {
    const { drawsLocally, local, served } = document.querySelector("irr-stage");
    // WebGPU's canvas is empty after the browser has composed it.
    if (drawsLocally) local.painter.present();
    return (drawsLocally ? local.canvas : served).toDataURL("image/png");
  });
  return PNG.sync.read(Buffer.from(address.split(",")[1], "base64"));
}

/** Changes the page's state. @param {import("playwright-core").Page} page @param {object} values */
export const set = (page, values) => page.evaluate(async (values) => {
  (await import("/page/js/state.js")).state.set(values);
  // The layout changes in the next frame, and the picture's size after that.
  for (let i = 0; i < 3; i += 1) await new Promise(requestAnimationFrame);
}, values);
export const get = (page, key) => page.evaluate(async (key) => (await import("/page/js/state.js")).state.get(key), key);

export const readPng = (path) => PNG.sync.read(readFileSync(path));

let frames = 0;

/** The program's picture from a page's camera. */
export function renderFrom(camera, scene, { width, height }) {
  const out = join(scratch, `frames_${(frames += 1)}`);
  const file = `${out}.json`;
  writeFileSync(file, JSON.stringify({ irradia_path: 1, fps: 30, loop: false, ease: false, closing: 0, keys: [{ time: 0, ...camera }] }));
  mkdirSync(out);
  run("render", scene, "--path", file, "--size", `${width}x${height}`, "--out", out);
  return readPng(join(out, readdirSync(out)[0]));
}

/** PSNR in dB of the colours. */
export function psnr(a, b) {
  if (a.width !== b.width || a.height !== b.height) throw new Error(`${a.width}x${a.height} against ${b.width}x${b.height}`);
  let sum = 0;
  for (let i = 0; i < a.data.length; i += 1) if (i % 4 !== 3) sum += (a.data[i] - b.data[i]) ** 2;
  return -10 * Math.log10(sum / (a.width * a.height * 3 * 255 * 255));
}
