// The page as a new user finds it: views, tools, a live training, several pages, a server that dies.

import assert from "node:assert/strict";
import { join } from "node:path";
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { after, before, test } from "node:test";
import { OUT, browse, get, open, picture, psnr, run, scratch, serve, set, sharp, stopAll, until } from "./harness.js";
import { dataset, lit, trained } from "./scenes.js";

/** @type {import("playwright-core").Browser} */
let browser;
before(async () => (browser = await browse()));
after(async () => {
  stopAll();
  await browser.close();
});

const settled = (page) => sharp(page);

test("views, comparison, tools and modes", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page, problems } = await open(browser, server.address, { width: 1000, height: 700 });
  await set(page, { drawing: "served" });
  await page.getByRole("tab", { name: "Views" }).click();
  await page.locator(".views button").nth(3).click();
  await settled(page);
  assert.equal(await get(page, "view"), 3);
  await page.getByRole("button", { name: "Slider" }).click();
  await page.locator("img.photo").waitFor({ state: "visible" });
  // The picture is exactly over the photograph.
  const size = await page.evaluate(() => [document.querySelector("irr-stage").served.width, document.querySelector("irr-stage").served.height]);
  assert.ok(Math.abs(size[0] / size[1] - 160 / 120) < 0.01);
  await page.getByRole("button", { name: "Error", exact: true }).click();
  await settled(page);
  await page.locator(".legend").getByText("Mean error").waitFor();
  await page.keyboard.press("Escape");
  assert.equal(await get(page, "view"), null);

  await page.getByRole("button", { name: "Measure PSNR" }).click();
  await until(page, async () => (await import("/page/js/state.js")).state.get("scores").size === 27);
  await page.getByRole("button", { name: "Worst first" }).click();
  const listed = await page.locator(".views button > span:last-child").allTextContents();
  const numbers = listed.map(Number);
  assert.ok(numbers[0] > 10 && numbers.every((value, i) => i === 0 || value >= numbers[i - 1]));

  await page.keyboard.press("h");
  await settled(page);
  const color = await picture(page);
  for (const [key, mode] of [["2", "depth"], ["3", "alpha"], ["4", "normals"], ["5", "count"], ["6", "ellipses"], ["7", "rings"], ["8", "points"]]) {
    await page.keyboard.press(key);
    assert.equal(await get(page, "mode"), mode);
    await settled(page);
    assert.ok(psnr(color, await picture(page)) < 25, mode);
  }
  await page.keyboard.press("1");
  await settled(page);

  const box = await page.locator("irr-stage .overlay").boundingBox();
  const middle = { x: box.width / 2, y: box.height / 2 };
  const before = await get(page, "pivot");
  await page.locator("irr-stage .overlay").dblclick({ position: { x: middle.x + 60, y: middle.y + 20 } });
  await until(page, async (before) => `${(await import("/page/js/state.js")).state.get("pivot")}` !== `${before}`, before);
  await settled(page);
  await page.keyboard.press("i");
  await page.locator("irr-stage .overlay").click({ position: middle });
  await until(page, async () => (await import("/page/js/state.js")).state.get("picked")?.splat?.opacity > 0);
  await page.keyboard.press("m");
  // A drag turns, and measures nothing.
  const turned = (await get(page, "camera")).position;
  await page.mouse.move(box.x + middle.x, box.y + middle.y);
  await page.mouse.down();
  await page.mouse.move(box.x + middle.x + 20, box.y + middle.y, { steps: 4 });
  await page.mouse.up();
  assert.notDeepEqual((await get(page, "camera")).position, turned);
  assert.deepEqual(await get(page, "measured"), []);
  await page.locator("irr-stage .overlay").click({ position: middle });
  await until(page, async () => (await import("/page/js/state.js")).state.get("measured").length === 1);
  await page.locator("irr-stage .overlay").click({ position: { x: middle.x + 80, y: middle.y } });
  await until(page, async () => (await import("/page/js/state.js")).state.get("measured").length === 2);
  await page.getByRole("tab", { name: "Scene" }).click();
  await page.getByLabel("True length in metres").fill("1");
  await page.getByRole("button", { name: "Set scale" }).click();
  await until(page, async () => (await import("/page/js/state.js")).state.get("metres") > 0);
  assert.ok(JSON.parse(readFileSync(join(trained(), "unit.json"), "utf8")).metres_per_unit > 0);

  await page.keyboard.press("Escape");
  await set(page, { clip: [[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]] });
  await settled(page);
  assert.ok(psnr(color, await picture(page)) < 30, "the box clips");
  await page.keyboard.press("?");
  await page.getByText("Keys and gestures").waitFor();
  await page.keyboard.press("Escape");
  assert.deepEqual(problems, []);
  await server.stop();
});

test("the list of views stays where it is while scores arrive", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page, problems } = await open(browser, server.address, { width: 900, height: 400 });
  await page.getByRole("tab", { name: "Views" }).click();
  await page.getByRole("button", { name: "Worst first" }).click();
  const seen = await page.evaluate(async () => {
    const { state } = await import("/page/js/state.js");
    const pane = document.querySelector("irr-sidebar .pane");
    const entry = /** @type {HTMLElement} */ (document.querySelectorAll(".views button")[20]);
    const others = state.get("views").map((_, view) => [view, 30]).filter(([view]) => view !== 20);
    // The view that the camera is in is at the top of the list.
    state.set({ view: 0, scores: new Map(others) });
    entry.focus();
    pane.scrollTop = pane.scrollHeight;
    const top = pane.scrollTop;
    state.set({ scores: new Map([...others, [20, 10]]) });
    const first = document.querySelector(".views button");
    return { top, after: pane.scrollTop, focused: document.activeElement === entry, sorted: first === entry, text: entry.lastElementChild.textContent };
  });
  assert.ok(seen.top > 0);
  assert.deepEqual(seen, { top: seen.top, after: seen.top, focused: true, sorted: true, text: "10.00" });
  assert.deepEqual(problems, []);
  await server.stop();
});

test("a photograph that cannot be loaded is explained, and requested again", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page } = await open(browser, server.address, { width: 500, height: 400 });
  await set(page, { drawing: "served", view: 0 });
  await page.route("**/photo?*", (route) => route.fulfill({ status: 404, body: "r_0.png is damaged" }));
  await set(page, { compare: "slider" });
  await page.getByText("r_0.png is damaged").waitFor();
  await page.unroute("**/photo?*");
  await set(page, { compare: "blink" });
  await until(page, () => document.querySelector("img.photo").naturalWidth > 0);
  await server.stop();
});

test("the photograph of another view is not shown in place of one that is being loaded", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page, problems } = await open(browser, server.address, { width: 500, height: 400 });
  const opacity = () => page.locator("img.photo").evaluate((photo) => getComputedStyle(photo).opacity);
  await set(page, { drawing: "served", view: 0, compare: "slider" });
  await until(page, () => document.querySelector("img.photo").style.opacity === "1");
  const held = new Promise((resolve) => page.route("**/view/1/photo?*", resolve));
  await set(page, { view: 1 });
  const route = await held;
  assert.equal(await opacity(), "0");
  await route.continue();
  await until(page, () => document.querySelector("img.photo").style.opacity === "1");
  assert.deepEqual(problems, []);
  await server.stop();
});

test("a long message is whole on a narrow screen", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page } = await open(browser, server.address, { width: 360, height: 740 });
  await set(page, { problem: `cannot read ${"photographs/of/a/capture/".repeat(6)}a.png: it is damaged` });
  const { left, right } = await page.getByText("cannot read").evaluate((chip) => chip.getBoundingClientRect().toJSON());
  assert.ok(left >= 0 && right <= 360, `${left} to ${right}`);
  await server.stop();
});

test("no key acts behind the sheet of keys", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page } = await open(browser, server.address, { width: 900, height: 700 });
  await set(page, { frusta: false });
  const before = await get(page, "camera");
  await page.keyboard.press("?");
  // Takes the focus from the button.
  await page.getByRole("heading", { name: "Keys and gestures" }).click();
  for (const key of ["v", "w", "ArrowLeft", "x"]) await page.keyboard.press(key, { delay: 50 });
  assert.deepEqual([await get(page, "frusta"), await get(page, "camera")], [false, before]);
  await page.keyboard.press("Escape");
  await page.keyboard.press("v");
  assert.equal(await get(page, "frusta"), true);
  await server.stop();
});

test("a scene is shown in the light of one of its photographs", async () => {
  const dark = 3;
  const server = await serve("view", lit(27, dark), "--port", "0");
  const { page, problems } = await open(browser, server.address, { width: 1000, height: 700 });
  await set(page, { drawing: "served", axes: false });
  await settled(page);
  const mean = await picture(page);
  const darker = { ...mean, data: mean.data.map((value, i) => (i % 4 === 3 ? value : Math.round(value / 2))) };
  const select = page.getByLabel("Light", { exact: true });
  assert.equal(await select.locator("option").count(), 25);
  const views = await get(page, "views");
  assert.ok(views[dark].trained);
  await select.selectOption(`${dark}`);
  await settled(page);
  assert.ok(psnr(darker, await picture(page)) > 36, "half of the light");
  // The page itself cannot draw in the light of a photograph.
  await set(page, { drawing: "local" });
  assert.equal(await page.evaluate(() => document.querySelector("irr-stage").drawsLocally), false);
  await set(page, { light: null, drawing: "served" });
  await settled(page);
  assert.ok(psnr(mean, await picture(page)) > 45);
  // Compared with a photograph, the scene is shown in its light.
  await page.evaluate((dark) => document.querySelector("irr-stage").navigation.enter(dark), dark);
  await until(page, async (dark) => (await import("/page/js/state.js")).state.get("view") === dark, dark);
  await settled(page);
  const inside = await picture(page);
  await set(page, { compare: "slider" });
  await settled(page);
  const compared = await picture(page);
  const sum = (image) => image.data.reduce((total, value, i) => (i % 4 === 3 ? total : total + value), 0);
  assert.ok(Math.abs(sum(compared) / sum(inside) - 0.5) < 0.02);
  assert.deepEqual(problems, []);
  await server.stop();
});

test("a live training is paused, stepped, resumed and left alone, and its bytes stay the same", async () => {
  const out = join(scratch, "live");
  const server = await serve("train", dataset(), "--out", out, "--steps", "1500", "--view", "--port", "0");
  const first = await open(browser, server.address, { width: 900, height: 600 });
  const { page } = first;
  await page.getByRole("tab", { name: "Training" }).click();
  await page.getByRole("button", { name: "Pause" }).click();
  await until(page, async () => (await import("/page/js/state.js")).state.get("train")?.phase === "paused");
  const step = (await get(page, "train")).step;
  assert.ok(step > 0 && step < 1500);
  assert.match(await page.title(), new RegExp(`^${Math.floor(step / 15)} % · .*live · Irradia$`));
  const second = await open(browser, server.address, { width: 400, height: 300 });
  await page.getByRole("button", { name: "Save now" }).click();
  await until(page, async (step) => (await import("/page/js/state.js")).state.get("train").saved === step, step);
  await page.waitForTimeout(400);
  assert.equal((await get(page, "train")).step, step, "it stands still");
  await page.getByRole("button", { name: "One step" }).click();
  await until(page, async (step) => {
    const train = (await import("/page/js/state.js")).state.get("train");
    return train.phase === "paused" && train.step === step + 1;
  }, step);
  await sharp(page);
  const before = await picture(page);
  await page.screenshot({ path: join(OUT, "training-1440-dark.jpg"), quality: 80 });
  await page.getByRole("button", { name: "Resume" }).click();
  await until(page, async (step) => (await import("/page/js/state.js")).state.get("train").step > step + 60, step);
  // Closing a page has no effect on the other one, which sees the scene improve.
  await second.page.close();
  await until(page, async () => (await import("/page/js/state.js")).state.get("train").phase === "finished");
  assert.match(await page.title(), /^[^%]*live · Irradia$/);
  await sharp(page);
  assert.ok(psnr(before, await picture(page)) < 45, "the scene has changed");
  assert.ok((await get(page, "train")).curve.length > 100);
  assert.deepEqual([...first.problems, ...second.problems], []);
  await page.close();
  assert.equal(await server.ended, 0, server.lines.join(""));

  const alone = join(scratch, "alone");
  run("train", dataset(), "--out", alone, "--steps", "1500");
  const hash = (folder) => createHash("sha256").update(readFileSync(join(folder, "scene.ply"))).digest("hex");
  assert.equal(hash(out), hash(alone), "pages change no byte");
});

test("two pages have a camera each, and come back after the server died", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const port = new URL(server.address).port;
  const [a, b] = [await open(browser, server.address, { width: 500, height: 400 }), await open(browser, server.address, { width: 500, height: 400 })];
  for (const { page } of [a, b]) await set(page, { drawing: "served" });
  await set(a.page, { view: null, camera: { ...(await get(a.page, "camera")), fov: 0.4 } });
  await Promise.all([sharp(a.page), sharp(b.page)]);
  assert.ok(psnr(await picture(a.page), await picture(b.page)) < 30);
  await server.stop("SIGKILL");
  await a.page.getByText("Connection lost").waitFor();
  const again = await serve("view", trained(), "--port", port);
  assert.equal(again.address, server.address);
  await until(a.page, async () => (await import("/page/js/state.js")).state.get("connection") === "open");
  await sharp(a.page);
  assert.ok(Math.abs((await get(a.page, "camera")).fov - 0.4) < 1e-6, "the camera stays");
  await again.stop();
});

test("a page that draws itself keeps its splats while the connection is broken, and loads them again from another server", async () => {
  const local = await browse("webgl");
  const server = await serve("view", trained(), "--port", "0");
  const { page, problems } = await open(local, server.address, { width: 500, height: 400 });
  await set(page, { drawing: "local", axes: false });
  await sharp(page);
  const before = await picture(page);
  let loads = 0;
  const isLoad = (request) => new URL(request.url()).pathname === "/splats";
  page.on("request", (request) => isLoad(request) && (loads += 1));
  const reconnect = () => page.evaluate(async () => {
    const [{ connection }, { state }] = await Promise.all(["connection", "state"].map((name) => import(`/page/js/${name}.js`)));
    const told = new Promise((resolve) => state.addEventListener("editing", resolve, { once: true }));
    connection.socket.close();
    // It comes after the greeting.
    await told;
  });
  await reconnect();
  await sharp(page);
  assert.ok(psnr(before, await picture(page)) > 60);
  await set(page, { view: null, camera: { ...(await get(page, "camera")), fov: 0.4 } });
  await sharp(page);
  const near = await picture(page);
  assert.ok(psnr(before, near) < 30, "it still draws");
  await set(page, { drawing: "served" });
  await sharp(page);
  assert.ok(psnr(near, await picture(page)) > 35, "and is still served");
  await set(page, { drawing: "local" });
  await page.evaluate(async () => (await import("/page/js/edit/session.js")).session.select([{ shape: "half-space", point: [0, 0, 0], normal: [1, 0, 0] }], "replace"));
  await until(page, () => document.querySelector("irr-stage").local.masked > 0);
  const masked = await page.evaluate(() => document.querySelector("irr-stage").local.masked);
  await reconnect();
  assert.equal(await page.evaluate(() => document.querySelector("irr-stage").local.masked), masked, "the selection stays");
  assert.equal(loads, 0, "the splats are those of before");
  assert.deepEqual(problems, []);

  const again = page.waitForRequest(isLoad);
  await server.stop("SIGKILL");
  const other = await serve("view", trained(), "--port", new URL(server.address).port);
  await again;
  await until(page, () => document.querySelector("irr-stage").local.masked === 0);
  await sharp(page);
  assert.ok(psnr(near, await picture(page)) > 50);
  await other.stop();
  await local.close();
});

test("where too many pages are open, a page says so and tries again less and less often", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const page = await (await browser.newContext()).newPage();
  let tries = 0;
  await page.routeWebSocket(/socket/, (socket) => {
    tries += 1;
    setTimeout(() => socket.close({ code: 1013, reason: "there are too many pages" }), 50);
  });
  await page.goto(server.address);
  await page.getByText("Too many pages").waitFor();
  tries = 0;
  await page.waitForTimeout(3000);
  assert.ok(tries <= 4, `${tries} tries`);
  assert.ok(await page.getByText("Too many pages").isVisible());
  await server.stop();
});

test("on a screen of another density the picture has its pixels", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page, context } = await open(browser, server.address, { width: 500, height: 400 });
  await set(page, { drawing: "served" });
  const session = await context.newCDPSession(page);
  await session.send("Emulation.setDeviceMetricsOverride", { width: 500, height: 400, deviceScaleFactor: 2, mobile: false });
  await until(page, () => devicePixelRatio === 2);
  await until(page, () => {
    const stage = document.querySelector("irr-stage");
    return stage.served.width === 2 * stage.clientWidth && stage.overlay.width === 2 * stage.clientWidth;
  });
  await server.stop();
});

test("the preview of a path ends when the camera is moved", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page } = await open(browser, server.address, { width: 500, height: 400 });
  await set(page, { drawing: "served", tab: "path" });
  await page.evaluate(async () => {
    const [{ path }, { state }] = await Promise.all(["path", "state"].map((name) => import(`/page/js/${name}.js`)));
    const camera = state.get("camera");
    path.loop = true;
    for (const x of [0, 1]) path.add({ ...camera, position: [camera.position[0] + x, camera.position[1], camera.position[2]] });
  });
  const moves = async () => {
    const before = await get(page, "camera");
    await page.waitForTimeout(300);
    return (await get(page, "camera")).position[0] !== before.position[0];
  };
  await page.keyboard.press(" ");
  assert.ok(await moves());
  await page.locator("irr-stage .overlay").hover();
  await page.mouse.wheel(0, -100);
  await until(page, () => document.querySelector("irr-timeline").playing === false);
  assert.equal(await moves(), false);
  await server.stop();
});

test("key frames are moved in time by pointer and keyboard, and a camera path that is not one is refused in a line", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page, problems } = await open(browser, server.address, { width: 800, height: 600 });
  await set(page, { drawing: "served", sidebar: true, tab: "path" });
  const saved = await page.evaluate(async () => {
    const [{ path }, { state }] = await Promise.all(["path", "state"].map((name) => import(`/page/js/${name}.js`)));
    for (let i = 0; i < 3; i += 1) path.add(state.get("camera"));
    return JSON.stringify(path);
  });
  const times = () => page.evaluate(async () => (await import("/page/js/path.js")).path.keys.map(({ time }) => time));
  const mark = (number) => page.getByRole("button", { name: `Key frame ${number} at` });
  const dragTo = async (number, share) => {
    const [track, box] = [await page.locator("irr-timeline .track").boundingBox(), await mark(number).boundingBox()];
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    await page.mouse.down();
    await page.mouse.move(track.x + share * track.width, track.y, { steps: 5 });
    await page.mouse.up();
  };
  const camera = { ...(await get(page, "camera")), fov: 0.5 };
  await set(page, { camera });
  const near = async (expected) => {
    const found = await times();
    assert.ok(found.every((time, i) => Math.abs(time - expected[i]) < 0.03), `${found} are not ${expected}`);
  };
  await dragTo(2, 0.75);
  await near([0, 3, 4]);
  assert.equal((await get(page, "camera")).fov, 0.5, "a drag is no click");
  await dragTo(3, 0.1);
  await near([0, 3, 3.1]);
  await dragTo(1, 0.5);
  await near([0, 3, 3.1]);
  await mark(2).focus();
  for (const key of ["ArrowLeft", "Shift+ArrowLeft"]) await page.keyboard.press(key);
  await near([0, 1.9, 3.1]);
  await page.keyboard.press("Delete");
  await near([0, 3.1]);
  assert.ok(await mark(2).evaluate((mark) => mark === document.activeElement));
  await mark(2).click();
  await until(page, async () => (await import("/page/js/state.js")).state.get("camera").fov !== 0.5);

  const file = page.locator("irr-path-panel input[type=file]");
  const read = (text) => file.setInputFiles({ name: "path.json", mimeType: "application/json", buffer: Buffer.from(text) });
  for (const [from, to, says] of [
    [/"fps":30/, '"fps":"30"', "frames per second"], [/"position":\[[^\]]*\]/, '"position":7', "no valid pose"], [/"time":0/, '"time":1', "begin at 0"],
    [/"fov":[^,}]*/, '"fov":4', "field of view"], [/"loop":false/, '"loop":null', "loop or ease"], [/.*/, "null", "not one that"], [/.*/, "nonsense", "not JSON"],
  ]) {
    assert.match(saved, from);
    await read(saved.replace(from, to));
    await page.locator("irr-stage .chip").getByText(says).waitFor();
  }
  await near([0, 3.1]);
  await read(saved);
  await until(page, async () => (await import("/page/js/path.js")).path.keys.length === 3);
  assert.deepEqual(problems, []);
  await server.stop();
});

test("an address holds the camera", async () => {
  const server = await serve("view", trained(), "--port", "0");
  const { page } = await open(browser, server.address, { width: 500, height: 400 });
  await page.locator("irr-stage .overlay").hover();
  const before = (await get(page, "camera")).position;
  await page.mouse.wheel(0, -300);
  // Playwright does not wait until the page receives the wheel event, or until its own `url()` follows the address bar.
  await until(page, async (before) => (await import("/page/js/state.js")).state.get("camera").position.some((v, i) => v !== before[i]), before);
  await page.keyboard.press("u");
  await until(page, () => location.hash.startsWith("#p="));
  const address = await page.evaluate(() => location.href);
  assert.match(address, /#p=/);
  const other = await open(browser, address, { width: 500, height: 400 });
  const [here, there] = [await get(page, "camera"), await get(other.page, "camera")];
  assert.ok(here.position.every((v, i) => Math.abs(v - there.position[i]) < 1e-4));
  assert.equal(await get(other.page, "view"), null, "it is in no view");
  // In the same tab, with a mode and a view that do not exist.
  await page.evaluate(() => (location.hash = `${location.hash.replace(/f=[^&]*/, "f=0.5")}&m=nonsense&v=999`));
  await until(page, async () => (await import("/page/js/state.js")).state.get("camera").fov === 0.5);
  await sharp(page);
  assert.deepEqual([await get(page, "mode"), await get(page, "view")], ["color", null]);
  await server.stop();
});

test("every screen at 1440, 768 and 360 pixels", async () => {
  // SCREENS_OF names a run to take pictures of, such as that of README.md: views-1440-dark.jpg.
  const server = await serve("view", process.env.SCREENS_OF ?? trained(), "--port", "0");
  for (const [width, height] of [[1440, 900], [768, 1024], [360, 740]]) {
    for (const theme of ["dark", "light"]) {
      const { page, problems } = await open(browser, server.address, { width, height, theme });
      await set(page, { drawing: "served" });
      const shoot = async (name) => {
        await sharp(page);
        await page.screenshot({ path: join(OUT, `${name}-${width}-${theme}.jpg`), quality: 80 });
        const wide = await page.evaluate(() => document.documentElement.scrollWidth);
        assert.ok(wide <= width, `${name} is ${wide} pixels wide`);
        const ends = await page.evaluate(() => document.querySelector("irr-toolbar").getBoundingClientRect().right);
        assert.ok(ends <= width, `the toolbar ends at ${ends}`);
      };
      await shoot("start");
      await set(page, { sidebar: true, tab: "display" });
      await shoot("scene");
      if (theme === "light") {
        await page.close();
        continue;
      }
      await set(page, { tab: "views", frusta: true });
      await page.waitForTimeout(300);
      await shoot("views");
      await page.locator(".views button").nth(3).click();
      await set(page, { compare: "slider" });
      await page.waitForTimeout(300);
      await shoot("compare");
      await set(page, { compare: "none", view: null, tab: "path", mode: "depth" });
      await page.evaluate(() => document.querySelector("irr-path-panel").fromViews());
      await page.keyboard.press("h");
      await shoot("path");
      await page.keyboard.press("?");
      await shoot("help");
      assert.deepEqual(problems, []);
      await page.close();
    }
  }
  await server.stop();
});
