// Measures the viewer: npm run bench [-- served|local|train ..]. Figures depend on this machine and its other load; compare within
// one run.

import { existsSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { browse, open, scratch, serve, set } from "./tests/harness.js";
import { random } from "./tests/scenes.js";

const SPLATS = 500_000;
/** Seconds of a window of a training, and number of windows of each kind. */
const WINDOW = 8;
const ROUNDS = 4;
const wanted = process.argv.slice(2);
const wants = (name) => wanted.length === 0 || wanted.includes(name);
const say = (name, value) => console.log(`${name.padEnd(58)} ${value}`);
/** CPU seconds of a process, user and system. */
const cpu = (pid) => {
  const fields = readFileSync(`/proc/${pid}/stat`, "utf8").split(") ")[1].split(" ");
  return (Number(fields[11]) + Number(fields[12])) / 100;
};
const percentile = (values, share) => [...values].sort((a, b) => a - b)[Math.min(values.length - 1, Math.floor(values.length * share))];

/** Turns the camera for some seconds; returns pictures per second, and delays. */
const turn = (page, seconds) => page.evaluate(async (seconds) => {
  const stage = document.querySelector("irr-stage");
  stage.delays.length = 0;
  let frames = 0;
  const count = () => (frames += 1);
  stage.addEventListener("drawing", count);
  const end = performance.now() + 1000 * seconds;
  const before = stage.shown?.header?.id ?? 0;
  let pictures = 0;
  let last = before;
  while (performance.now() < end) {
    stage.navigation.turn(2, 0);
    await new Promise(requestAnimationFrame);
    const id = stage.drawsLocally ? stage.local.painted : stage.shown?.header?.id;
    if (id !== last) pictures += 1;
    last = id;
  }
  stage.removeEventListener("drawing", count);
  return { fps: pictures / seconds, delays: stage.delays, size: stage.drawsLocally ? stage.local.canvas.width : stage.served.width };
}, seconds);

// The served picture is measured in a browser without a GPU; WebGL needs the software rasteriser.
const browser = await browse();
const drawing = wants("local") ? await browse("webgl") : null;

if (wants("served")) {
  const server = await serve("view", random(SPLATS), "--port", "0");
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 } });
  const page = await context.newPage();
  await page.addInitScript(() => addEventListener("DOMContentLoaded", () => {
    const look = () => {
      if (document.querySelector("irr-stage")?.shown?.header) globalThis.firstPicture = performance.now();
      else requestAnimationFrame(look);
    };
    look();
  }));
  await page.goto(server.address);
  await page.waitForFunction(() => globalThis.firstPicture, null, { timeout: 60000 });
  await set(page, { drawing: "served" });
  say(`served: first picture, ${SPLATS} splats, ms after navigation`, (await page.evaluate(() => globalThis.firstPicture)).toFixed(0));
  await turn(page, 3);
  const before = cpu(server.child.pid);
  const { fps, delays, size } = await turn(page, 10);
  say("served: pictures/s while moving", fps.toFixed(1));
  say("served: width of the moving picture, pixels", size);
  say("served: delay of input to picture, median and 95 %, ms", `${percentile(delays, 0.5)?.toFixed(0)} ${percentile(delays, 0.95)?.toFixed(0)}`);
  say("served: CPU seconds of the program per second of moving", ((cpu(server.child.pid) - before) / 10).toFixed(2));
  await page.waitForTimeout(3000);
  const idle = cpu(server.child.pid);
  await page.waitForTimeout(10000);
  say("served: CPU seconds of the program in 10 s at rest", (cpu(server.child.pid) - idle).toFixed(2));
  await server.stop();
  await context.close();
}

if (wants("local")) {
  const server = await serve("view", random(SPLATS), "--port", "0");
  const { page } = await open(drawing, server.address, { width: 640, height: 400 });
  const sort = await page.evaluate(async () => {
    const { order, reserve, take } = await import("/page/js/local/order.js");
    const count = 1_000_000;
    reserve(count);
    const positions = Float32Array.from({ length: 3 * count }, () => Math.random() - 0.5);
    take({ first: 0, count, positions, radii: new Float32Array(count).fill(0.01) });
    const look = { right: [1, 0, 0], down: [0, 1, 0], forward: [0, 0, 1], position: [0, 0, -2], limits: [-2, 2, -2, 2], near: 0.01 };
    const times = [];
    for (let i = 0; i < 25; i += 1) {
      const started = performance.now();
      if (order(look).length !== count) throw new Error("not all are in view");
      times.push(performance.now() - started);
    }
    return times.slice(4).sort((a, b) => a - b);
  });
  say("local: sort of 1,000,000 splats, least and median, ms", `${sort[0].toFixed(1)} ${sort[Math.floor(sort.length / 2)].toFixed(1)}`);
  await set(page, { drawing: "local" });
  await page.waitForFunction(() => {
    const { local } = document.querySelector("irr-stage");
    return local.total > 0 && local.loaded === local.total && local.sharp;
  }, null, { timeout: 120000 });
  const { fps, size } = await turn(page, 10);
  say(`local: pictures/s while moving, ${SPLATS} splats, no GPU`, `${fps.toFixed(1)} at ${size} pixels`);
  await server.stop();
}

if (wants("train")) {
  const data = join(import.meta.dirname, "../../../../shared/data/fox_colmap");
  if (!existsSync(data)) console.log("SKIPPED (no ../shared): training with pages");
  else {
    // One run with windows of each kind in turn, so that neither the growth of the scene nor opening the page counts.
    const out = join(scratch, "watched");
    const server = await serve("train", data, "--out", out, "--steps", "100000", "--downscale", "2", "--holdout", "0", "--view", "--port", "0");
    const steps = () => Number(/.*"step":(\d+)/s.exec(readFileSync(join(out, "events.jsonl"), "utf8").slice(-4000))?.[1] ?? 0);
    const { page } = await open(browser, server.address, { width: 1280, height: 800 });
    const rows = { alone: [], resting: [], moving: [] };
    for (let round = 0; round < ROUNDS; round += 1) {
      for (const kind of /** @type {const} */ (["alone", "resting", "moving"])) {
        await page.goto(kind === "alone" ? "about:blank" : server.address);
        await page.waitForTimeout(2500);
        const [from, since] = [steps(), performance.now()];
        if (kind === "moving") say("train: pictures/s while moving", (await turn(page, WINDOW)).fps.toFixed(1));
        else await page.waitForTimeout(1000 * WINDOW);
        rows[kind].push((1000 * (steps() - from)) / (performance.now() - since));
      }
    }
    for (const [name, values] of Object.entries(rows)) say(`train: steps/s, ${name}`, values.map((value) => value.toFixed(0)).join(" "));
    await page.close();
    await server.stop();
  }
}

await browser.close();
await drawing?.close();
