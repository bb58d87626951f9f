// Shared pages in Firefox: opened from a file, without a network.

import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { existsSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import { after, before, test } from "node:test";
import puppeteer from "puppeteer-core";
import { run, scratch } from "./harness.js";
import { trained } from "./scenes.js";
import { isSettled, looksAsDrawn, SIZE, watch } from "./shared.js";

const FIREFOX = [process.env.FIREFOX, "/usr/bin/firefox-esr", "/usr/bin/firefox"].find((path) => path && existsSync(path));
// Headless Firefox has no WebGL without a GPU: it gets a virtual screen, on which Mesa draws.
const XVFB = "/usr/bin/Xvfb";
const skip = !FIREFOX ? "Firefox is not installed" : !process.env.DISPLAY && !existsSync(XVFB) ? "there is neither a screen nor Xvfb" : false;
if (skip) console.log(`SKIPPED: shared pages were NOT opened in Firefox: ${skip}`);

/** @type {import("node:child_process").ChildProcess | undefined} */
let screen;
/** @type {import("puppeteer-core").Browser} */
let browser;

/** Starts a virtual screen and returns its name. */
const startScreen = () => new Promise((resolve, reject) => {
  screen = spawn(XVFB, ["-displayfd", "3", "-screen", "0", "1280x800x24"], { stdio: ["ignore", "ignore", "ignore", "pipe"] });
  screen.on("error", reject);
  screen.on("exit", () => reject(new Error("Xvfb ended")));
  screen.stdio[3].on("data", (number) => resolve(`:${String(number).trim()}`));
});

before(async () => {
  if (skip) return;
  const display = process.env.DISPLAY ?? (await startScreen());
  browser = await puppeteer.launch({
    browser: "firefox",
    executablePath: FIREFOX,
    headless: false,
    env: { ...process.env, DISPLAY: display, LIBGL_ALWAYS_SOFTWARE: "1" },
    // No network: requests go to a proxy that does not exist.
    extraPrefsFirefox: { "webgl.force-enabled": true, "network.proxy.type": 1, "network.proxy.http": "127.0.0.1", "network.proxy.http_port": 9, "network.proxy.ssl": "127.0.0.1", "network.proxy.ssl_port": 9 },
  });
});
after(async () => {
  await browser?.close();
  screen?.removeAllListeners("exit");
  screen?.kill();
});

test("a trained scene opens in Firefox and looks as the program draws it", { skip }, async (context) => {
  const blank = await browser.newPage();
  if (!(await blank.evaluate(() => document.createElement("canvas").getContext("webgl2") !== null))) {
    console.log("SKIPPED: shared pages were NOT opened in Firefox: it has no WebGL2 here");
    return context.skip();
  }
  const scene = trained();
  const html = join(scratch, "firefox.html");
  run("share", scene, "-o", html, "--title", "In Firefox");
  const page = await browser.newPage();
  await page.setViewport(SIZE);
  const { problems, asked } = watch(page);
  await page.goto(pathToFileURL(html).href);
  const settled = async () => {
    await new Promise((resolve) => setTimeout(resolve, 200));
    await page.waitForFunction(isSettled, { timeout: 120000 });
  };
  await settled();
  const db = await looksAsDrawn(page, scene, "shared_firefox.png", { settled, zoom: () => page.mouse.wheel({ deltaY: -200 }) });
  console.log(`${await browser.version()}: ${db.toFixed(2)} dB`);
  assert.deepEqual(problems, []);
  assert.deepEqual(asked.filter((address) => address !== pathToFileURL(html).href), []);
});
