// Editing in the page: tools, handles, undo, files. The page's result is that of the program with the saved list.

import assert from "node:assert/strict";
import { join } from "node:path";
import { cpSync, existsSync, readFileSync, readdirSync, writeFileSync } from "node:fs";
import { after, before, test } from "node:test";
import { OUT, browse, get, open, picture, pretendGpu, psnr, readPng, run, scratch, serve, set, sharp, stopAll, until } from "./harness.js";
import { dataset, trained } from "./scenes.js";

/** @type {import("playwright-core").Browser} */
let browser;
before(async () => (browser = await browse()));
after(async () => {
  stopAll();
  await browser.close();
});

/** A copy of the run, so that saved files do not disturb other tests. @param {string} name */
function copy(name) {
  const out = join(scratch, name);
  if (!existsSync(out)) cpSync(trained(), out, { recursive: true });
  return out;
}

/** Waits until the server has carried out the requests, and its picture has arrived. @param {(editing: any) => boolean} holds */
async function edited(page, holds) {
  const end = Date.now() + 120000;
  for (;;) {
    const editing = await get(page, "editing");
    if (editing && !editing.busy && holds(editing)) break;
    if (Date.now() > end) throw new Error(`it never held: ${holds} of ${JSON.stringify(editing)}`);
    await page.waitForTimeout(30);
  }
  await until(page, async () => {
    const { drawsLocally, shown } = document.querySelector("irr-stage");
    return drawsLocally || shown?.header?.version >= (await import("/page/js/state.js")).state.get("editing").version;
  });
  await sharp(page);
}

/** Drags along points, given as shares of the stage. */
async function drag(page, points, modifiers = []) {
  const box = await page.locator("irr-stage .overlay").boundingBox();
  const at = ([x, y]) => [box.x + x * box.width, box.y + y * box.height];
  for (const key of modifiers) await page.keyboard.down(key);
  await page.mouse.move(...at(points[0]));
  await page.mouse.down();
  for (const point of points.slice(1)) await page.mouse.move(...at(point), { steps: 6 });
  await page.mouse.up();
  for (const key of modifiers) await page.keyboard.up(key);
}

const LASSO = [[0.35, 0.3], [0.65, 0.3], [0.68, 0.6], [0.5, 0.7], [0.33, 0.6], [0.35, 0.32]];

test("what is beside a line or beyond a plane is selected, and a list of edits is opened", async () => {
  const scene = copy("cut");
  const server = await serve("view", scene, "--port", "0");
  const { page, problems } = await open(browser, server.address);
  await set(page, { drawing: "served", axes: false });
  await page.getByRole("tab", { name: "Edit" }).click();
  await sharp(page);
  await page.getByRole("button", { name: "Cut" }).click();
  // Drawn upwards through the middle, then downwards: the two halves.
  await drag(page, [[0.5, 0.8], [0.5, 0.2]]);
  await edited(page, (e) => e.at === 1);
  const [left, all] = await get(page, "editing").then((e) => [e.selected, e.of]);
  await drag(page, [[0.5, 0.2], [0.5, 0.8]], ["Shift"]);
  await edited(page, (e) => e.at === 2);
  assert.ok(left > 0 && left < all, `${left} of ${all}`);
  assert.equal((await get(page, "editing")).selected, all, "both together");
  await page.getByLabel("Select by a measure").selectOption("farther");
  await edited(page, (e) => e.at === 3);
  const far = (await get(page, "editing")).selected;
  assert.ok(far > 0, `${far}`);

  await page.getByLabel("edits.toml", { exact: true }).setInputFiles({
    name: "edits.toml", mimeType: "text/plain", buffer: Buffer.from(`version = 1
[[edits]]
op = "delete"
[[edits.select]]
shape = "half-space"
point = [0, 0, 0]
normal = [1, 0, 0]
[[edits]]
op = "scale"
factor = 2
`),
  });
  await edited(page, (e) => e.at === 5 && e.of < 1e9);
  const { of } = await get(page, "editing");
  assert.ok(of > 0 && of < all, `${of} of ${all} are left`);
  const replayed = join(scratch, "cut.ply");
  const said = run("edit", join(scene, "scene.ply"), "-o", replayed, "delete half-space point=0,0,0 normal=1,0,0", "scale factor=2");
  if (said) assert.match(said, new RegExp(`: ${of} splats`));
  await page.getByRole("button", { name: "Undo" }).click();
  await page.getByRole("button", { name: "Undo" }).click();
  await edited(page, (e) => e.at === 3 && e.of === all);
  await page.getByLabel("edits.toml", { exact: true }).setInputFiles({ name: "edits.toml", mimeType: "text/plain", buffer: Buffer.from("nonsense") });
  await until(page, async () => document.body.innerText.includes("TOML") || document.body.innerText.includes("list"));
  await page.getByLabel("edits.toml", { exact: true }).setInputFiles({ name: "edits.toml", mimeType: "text/plain", buffer: Buffer.alloc(17 << 20, "#") });
  await page.getByText("takes 17 MiB").waitFor();
  assert.equal(await get(page, "connection"), "open");
  assert.deepEqual(problems, []);
  await server.stop();
});

test("a double click closes a polygon, Space switches a check box, and a double step enters the view after the next", async () => {
  const server = await serve("view", copy("polygon"), "--port", "0");
  const { page, problems } = await open(browser, server.address);
  await set(page, { drawing: "served", axes: false });
  await page.getByRole("tab", { name: "Edit" }).click();
  await sharp(page);
  await page.getByRole("button", { name: "Polygon" }).click();
  const { x: left, y: top, width, height } = await page.locator("irr-stage .overlay").boundingBox();
  const at = (x, y) => [left + x * width, top + y * height];
  for (const corner of [at(0.3, 0.3), at(0.7, 0.3)]) await page.mouse.click(...corner);
  await page.mouse.dblclick(...at(0.5, 0.8));
  await edited(page, ({ selected }) => selected > 0);
  await page.keyboard.press("Escape");
  const box = page.getByLabel("Highlight");
  const before = await box.isChecked();
  await box.focus();
  await page.keyboard.press(" ");
  assert.equal(await box.isChecked(), !before);
  await page.keyboard.press("]");
  await page.keyboard.press("]");
  await until(page, async () => (await import("/page/js/state.js")).state.get("view") === 1);
  assert.deepEqual(problems, []);
  await server.stop();
});

test("a lasso, a brush and a deletion; undo, save and download agree with the program", async () => {
  const scene = copy("edited");
  const server = await serve("view", scene, "--port", "0");
  const { page, problems } = await open(browser, server.address);
  const other = await open(browser, server.address, { width: 500, height: 400 });
  await set(page, { drawing: "served", axes: false });
  await page.getByRole("tab", { name: "Edit" }).click();
  await sharp(page);
  const opened = await picture(page);

  await page.getByRole("button", { name: "Lasso" }).click();
  await drag(page, LASSO);
  await edited(page, (e) => e.selected > 0);
  const lassoed = (await get(page, "editing")).selected;
  const tinted = await picture(page);
  assert.ok(psnr(opened, tinted) < 35, "the selection is seen");
  await page.screenshot({ path: join(OUT, "edit-1440-dark.png") });
  await page.getByRole("button", { name: "Brush" }).click();
  await drag(page, [[0.5, 0.3], [0.5, 0.6]], ["Alt"]);
  await edited(page, (e) => e.at === 2);
  const selected = (await get(page, "editing")).selected;
  assert.ok(selected > 0 && selected < lassoed, "Alt takes away");
  await until(other.page, async (selected) => (await import("/page/js/state.js")).state.get("editing").selected === selected, selected);

  await page.keyboard.press("Delete");
  await edited(page, (e) => e.at === 3 && e.selected === 0);
  const deleted = await picture(page);
  assert.ok(psnr(opened, deleted) < 30, "the picture has changed");
  await page.keyboard.press("Control+z");
  await page.keyboard.press("Control+z");
  await page.keyboard.press("Control+z");
  await edited(page, (e) => e.at === 0);
  assert.equal(psnr(opened, await picture(page)), Infinity, "undone to the bit");
  for (let i = 0; i < 3; i += 1) await page.keyboard.press("Control+Shift+z");
  await edited(page, (e) => e.at === 3);
  assert.equal(psnr(deleted, await picture(page)), Infinity, "made again");
  await page.getByRole("button", { name: "Before" }).click();
  await edited(page, (e) => e.before);
  assert.equal(psnr(opened, await picture(page)), Infinity, "as it was");
  await page.getByRole("button", { name: "Before" }).click();
  await edited(page, (e) => !e.before);

  await page.getByRole("button", { name: "Save" }).click();
  await edited(page, (e) => Boolean(e.saved));
  assert.ok(existsSync(join(scene, "scene.edits.toml")) && existsSync(join(scene, "scene.edited.ply")));
  assert.match(readFileSync(join(scene, "scene.edits.toml"), "utf8"), /op = "delete"/);
  // The program makes the same scene from the list, and the page shows the same picture of it.
  const replayed = join(scratch, "replayed.ply");
  run("edit", join(scene, "scene.ply"), "-o", replayed, "--edits", join(scene, "scene.edits.toml"));
  assert.deepEqual(readFileSync(replayed), readFileSync(join(scene, "scene.edited.ply")));
  const again = await serve("view", replayed, "--port", "0");
  const shown = await open(browser, again.address);
  await set(shown.page, { drawing: "served", axes: false, tab: "edit", camera: await get(page, "camera") });
  await sharp(shown.page);
  assert.ok(psnr(deleted, await picture(shown.page)) > 35);
  await again.stop();

  await page.getByLabel("Format of the download").selectOption("compressed.ply");
  const [file] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Download" }).click()]);
  const packed = join(scratch, file.suggestedFilename());
  assert.equal(file.suggestedFilename(), "scene.compressed.ply");
  await file.saveAs(packed);
  run("convert", packed, join(scratch, "unpacked.ply"));
  assert.deepEqual([...problems, ...other.problems], []);
  await server.stop();
});

test("handles move what is selected, which stays selected, and a region is pulled", async () => {
  const server = await serve("view", copy("moved"), "--port", "0");
  const { page, problems } = await open(browser, server.address, { width: 1100, height: 760 });
  await set(page, { drawing: "served", axes: false, tab: "edit", sidebar: true });
  await page.getByRole("button", { name: "Rectangle" }).click();
  await drag(page, [[0.4, 0.4], [0.6, 0.6]]);
  await edited(page, (e) => e.selected > 0);
  const { selected, box } = await get(page, "editing");
  await page.getByRole("button", { name: "Rectangle" }).click();
  await page.getByRole("group", { name: "Handles" }).getByRole("button", { name: "Move" }).click();
  await sharp(page);
  const middle = await page.evaluate(async (box) => {
    const stage = document.querySelector("irr-stage");
    const { project } = await import("/page/js/camera.js");
    const at = project(stage.seen.camera, stage.seen.k, box[0].map((v, c) => (v + box[1][c]) / 2));
    return [at[0] / stage.seen.k.width, at[1] / stage.seen.k.height];
  }, box);
  await drag(page, [middle, [middle[0] + 0.1, middle[1]]]);
  await edited(page, (e) => e.at === 2);
  const moved = await get(page, "editing");
  assert.equal(moved.selected, selected, "the same splats");
  assert.ok(Math.hypot(...moved.box[0].map((v, c) => v - box[0][c])) > 0.01);
  await page.getByRole("group", { name: "Handles" }).getByRole("button", { name: "Scale" }).click();
  await drag(page, [[middle[0] + 0.1, middle[1]], [middle[0] + 0.15, middle[1] - 0.05]]);
  await edited(page, (e) => e.at === 3);
  const scaled = await get(page, "editing");
  assert.equal(scaled.selected, selected);
  const size = (box) => Math.hypot(...box[1].map((v, c) => v - box[0][c]));
  assert.ok(size(scaled.box) > 1.05 * size(moved.box));

  // All moves of a slider are one entry of the list.
  await page.getByLabel("Exposure").fill("1");
  await page.getByLabel("Exposure").fill("2");
  await edited(page, (e) => e.at === 4);
  assert.match((await get(page, "editing")).entries[3].text, /^Recolour/);
  await page.getByLabel("Exposure").fill("0.5");
  await edited(page, (e) => !e.busy);
  assert.equal((await get(page, "editing")).total, 4);

  await page.getByRole("button", { name: "Box" }).click();
  await edited(page, (e) => e.at === 5);
  const before = (await get(page, "editing")).selected;
  await set(page, { region: { ...(await get(page, "region")), half: [9, 9, 9] } });
  await edited(page, (e) => e.selected > before);
  assert.equal((await get(page, "editing")).at, 5, "one entry while it is pulled");
  await page.getByRole("button", { name: "Split off" }).click();
  await edited(page, (e) => e.at === 6);
  await page.keyboard.press("Control+z");
  await edited(page, (e) => e.at === 5 && e.selected > 0);
  assert.deepEqual(problems, []);
  await server.stop();
});

test("turning the scene upright keeps the picture, and views stay in place", async () => {
  const server = await serve("view", copy("upright"), "--port", "0");
  const { page, problems } = await open(browser, server.address, { width: 800, height: 560 });
  await set(page, { drawing: "served", axes: false, tab: "edit", sidebar: true });
  await sharp(page);
  const opened = await picture(page);
  const first = (await get(page, "views"))[0];
  await page.getByRole("button", { name: "This view's up" }).click();
  await edited(page, (e) => e.at === 1);
  assert.ok(psnr(opened, await picture(page)) > 45, "the camera turns with the scene");
  const up = await get(page, "up");
  assert.ok(up[1] < -0.9999, `up is ${up}`);
  // A page that is opened now sees the same from the same place.
  const late = await open(browser, server.address, { width: 800, height: 560 });
  const placed = (page) => page.evaluate(async () => (await import("/page/js/state.js")).state.get("views").map((view) => view.position).flat());
  const [here, there] = [await placed(page), await placed(late.page)];
  assert.ok(here.every((v, i) => Math.abs(v - there[i]) < 1e-6));
  await set(late.page, { drawing: "served", axes: false, tab: "edit", sidebar: true, camera: await get(page, "camera") });
  await sharp(late.page);
  assert.ok(psnr(await picture(page), await picture(late.page)) > 50);
  const turned = (await get(page, "views"))[0];
  assert.ok(Math.hypot(...turned.position.map((v, c) => v - first.position[c])) > 1e-3);
  await page.keyboard.press("Control+z");
  await edited(page, (e) => e.at === 0);
  assert.ok(psnr(opened, await picture(page)) > 60);
  assert.deepEqual(problems, []);
  await server.stop();
});

test("a saved camera path and the side seen first are those of the scene, however it is turned", async () => {
  const scene = copy("followed");
  const size = { width: 800, height: 560 };
  const server = await serve("view", scene, "--port", "0");
  const { page, problems } = await open(browser, server.address, size);
  await set(page, { drawing: "served", axes: false, tab: "edit", sidebar: true });
  await page.evaluate(async () => {
    const [{ path }, { state }] = [await import("/page/js/path.js"), await import("/page/js/state.js")];
    path.add(state.get("camera"));
  });
  const near = (a, b) => a.length > 0 && a.every((v, i) => Math.abs(v - b[i]) < 1e-3);
  const save = () => page.evaluate(async () => JSON.parse(JSON.stringify((await import("/page/js/path.js")).path)));
  const saved = await save();
  const opened = (await get(page, "camera")).position;
  await page.getByRole("button", { name: "This view's up" }).click();
  await edited(page, (e) => e.at === 1);
  const turned = (await get(page, "camera")).position;
  assert.ok(!near(turned, opened));
  assert.ok(near((await save()).keys[0].position, saved.keys[0].position), "the file is the same");
  const read = await page.evaluate(async (saved) => {
    const { path } = await import("/page/js/path.js");
    path.read(saved);
    return path.keys[0].position;
  }, saved);
  assert.ok(near(read, turned), "a file from before the turn fits");

  const late = await open(browser, server.address, size);
  assert.ok(near((await get(late.page, "camera")).position, turned), "a new page begins on the same side");
  await page.getByRole("button", { name: "Save" }).click();
  await edited(page, (e) => Boolean(e.saved));
  const again = await serve("view", join(scene, "scene.edited.ply"), "--port", "0");
  const other = await open(browser, again.address, size);
  assert.ok(near((await get(other.page, "camera")).position, turned), "so does a page on the saved scene");
  await again.stop();

  const file = join(scratch, "followed.json");
  writeFileSync(file, JSON.stringify(saved));
  const [before, after] = ["scene.ply", "scene.edited.ply"].map((name, i) => {
    const out = join(scratch, `followed_${i}`);
    run("render", join(scene, name), "--path", file, "--size", "160x120", "--out", out);
    return readPng(join(out, "frame_0000.png"));
  });
  assert.ok(psnr(before, after) > 40);
  assert.deepEqual([...problems, ...late.problems, ...other.problems], []);
  await server.stop();
});

test("metres stay the same when the scene is scaled, on a page that was not connected, too", async () => {
  const scene = copy("measured");
  const unit = join(scene, "unit.json");
  writeFileSync(unit, JSON.stringify({ metres_per_unit: 0.5 }));
  const server = await serve("view", scene, "--port", "0");
  const size = { width: 900, height: 700 };
  const [{ page, problems }, other] = [await open(browser, server.address, size), await open(browser, server.address, size)];
  const shown = (page) => page.evaluate(async () => {
    const [{ length, subtract }, { state }, { distanceText }] = await Promise.all(["math", "state", "units"].map((name) => import(`/page/js/${name}.js`)));
    const [a, b] = state.get("measured");
    return distanceText(length(subtract(a, b)));
  });
  for (const one of [page, other.page]) {
    await set(one, { drawing: "served", measured: [[0, 0, 0], [1, 0, 0]] });
    assert.equal(await shown(one), "50.00 cm");
  }
  await other.page.evaluate(async () => {
    const { connection } = await import("/page/js/connection.js");
    // It does not reconnect by itself.
    connection.wait = 1e9;
    connection.socket.close();
  });
  await until(other.page, async () => (await import("/page/js/state.js")).state.get("connection") === "lost");
  await page.evaluate(async () => (await import("/page/js/edit/session.js")).session.edit({ op: "scale", factor: 2 }, true));
  await edited(page, (e) => e.at === 1);
  assert.equal(await shown(page), "50.00 cm");
  await other.page.evaluate(async () => (await import("/page/js/connection.js")).connection.open());
  await until(other.page, async () => (await import("/page/js/state.js")).state.get("scene").placement.scale > 1.5);
  assert.equal(await shown(other.page), "50.00 cm");

  // What was one unit when the scene was opened is set to 2 m.
  await set(page, { sidebar: true, tab: "display" });
  await page.getByLabel("True length in metres").fill("2");
  await page.getByRole("button", { name: "Set scale" }).click();
  await until(page, async () => (await import("/page/js/state.js")).state.get("metres") !== 0.5);
  assert.ok(Math.abs(JSON.parse(readFileSync(unit, "utf8")).metres_per_unit - 2) < 1e-6);
  assert.equal(await shown(page), "2.000 m");
  await page.evaluate(async () => (await import("/page/js/edit/session.js")).session.undo());
  await edited(page, (e) => e.at === 0);
  assert.equal(await shown(page), "2.000 m");
  assert.deepEqual([...problems, ...other.problems], []);
  await server.stop();
});

// WebGPU in software is slow: a small picture, wide enough for the bar of tools.
for (const [api, size, before] of /** @type {const} */ ([["WebGL2", { width: 800, height: 560 }], ["WebGPU", { width: 800, height: 420 }, pretendGpu]])) test(`a page that draws itself with ${api} shows the selection and the edit`, async () => {
  const local = await browse(api === "WebGPU" ? "webgpu" : "webgl");
  const server = await serve("view", copy(`local_${api}`), "--port", "0");
  const { page, problems } = await open(local, server.address, { ...size, before });
  await set(page, { drawing: "local", axes: false, tab: "edit", sidebar: true });
  await sharp(page);
  assert.equal(await page.evaluate(() => document.querySelector("irr-stage").local.api), api);
  const opened = await picture(page);
  await page.getByRole("button", { name: "Rectangle" }).click();
  await drag(page, [[0.4, 0.4], [0.6, 0.6]]);
  await until(page, () => document.querySelector("irr-stage").local.masked > 0);
  await sharp(page);
  const tinted = await picture(page);
  assert.ok(psnr(opened, tinted) < 35);
  await set(page, { drawing: "served" });
  await sharp(page);
  assert.ok(psnr(tinted, await picture(page)) > 35, "here as on the server");
  await set(page, { drawing: "local" });
  await page.keyboard.press("Delete");
  await edited(page, (e) => e.at === 2);
  await until(page, () => document.querySelector("irr-stage").local.complete && document.querySelector("irr-stage").local.masked === 0);
  await sharp(page);
  const deleted = await picture(page);
  assert.ok(psnr(opened, deleted) < 30);
  await set(page, { drawing: "served" });
  await sharp(page);
  assert.ok(psnr(deleted, await picture(page)) > 35, "here as on the server");
  assert.deepEqual(problems, []);
  await server.stop();
  await local.close();
});

test("what cannot be edited says so, and the panel fits a telephone", async () => {
  const server = await serve("view", dataset(), "--port", "0");
  const { page } = await open(browser, server.address, { width: 500, height: 400 });
  await set(page, { tab: "edit", sidebar: true });
  await page.getByText("A dataset has no splats to edit").waitFor();
  assert.equal(await page.getByRole("button", { name: "Lasso" }).count(), 0);
  await server.stop();

  const scene = await serve("view", copy("small"), "--port", "0");
  for (const theme of ["dark", "light"]) {
    const small = await open(browser, scene.address, { width: 360, height: 740, theme });
    await set(small.page, { tab: "edit", sidebar: true });
    await small.page.getByRole("button", { name: "Lasso" }).click();
    await drag(small.page, LASSO);
    await edited(small.page, (e) => e.selected > 0);
    await small.page.screenshot({ path: join(OUT, `edit-360-${theme}.png`) });
    const wide = await small.page.evaluate(() => [...document.querySelectorAll("irr-edit-panel *")].filter((e) => e.getBoundingClientRect().right > innerWidth + 0.5).map((e) => e.outerHTML.slice(0, 80)));
    assert.deepEqual(wide, [], "nothing is cut off");
    const unnamed = await small.page.evaluate(() => [...document.querySelectorAll("irr-edit-panel button, irr-edit-panel input, irr-edit-panel select")]
      .filter((e) => !e.textContent?.trim() && !e.getAttribute("aria-label") && !/** @type {any} */ (e).labels?.length).map((e) => e.outerHTML.slice(0, 80)));
    assert.deepEqual(unnamed, [], "everything has a name");
  }
  await scene.stop();
  assert.ok(readdirSync(OUT).includes("edit-360-dark.png"));
});

test("another scene is merged, and the program makes the same of the saved list", async () => {
  const scene = copy("merged");
  const other = join(scratch, "other.sog");
  run("convert", scene, other);
  const server = await serve("view", scene, "--port", "0");
  const { page, problems } = await open(browser, server.address, { width: 700, height: 500 });
  await set(page, { drawing: "served", axes: false, tab: "edit", sidebar: true });
  await sharp(page);
  await page.getByLabel("Scene to merge").setInputFiles(other);
  await edited(page, (e) => e.at === 1);
  const { of, selected } = await get(page, "editing");
  assert.equal(of, 2 * selected, "what came is selected");
  await page.keyboard.press("Control+z");
  await edited(page, (e) => e.at === 0 && e.of === selected);
  await page.keyboard.press("Control+Shift+z");
  await edited(page, (e) => e.at === 1);
  await page.getByRole("button", { name: "Save" }).click();
  await edited(page, (e) => e.saved);
  const replayed = join(scratch, "merged.ply");
  run("edit", scene, "--edits", join(scene, "scene.edits.toml"), "-o", replayed);
  assert.deepEqual(readFileSync(replayed), readFileSync(join(scene, "scene.edited.ply")));
  await page.getByLabel("Scene to merge").setInputFiles({ name: "broken.ply", mimeType: "", buffer: Buffer.from("ply") });
  await until(page, () => document.querySelector("main, body")?.textContent?.includes("broken.ply"));
  assert.deepEqual(problems.filter((problem) => !problem.includes("422")), []);
  await server.stop();
});
