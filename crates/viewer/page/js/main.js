// Loads the parts of the page, and starts it.

import "./stage.js";
import "./hud.js";
import "./toolbar.js";
import "./sidebar.js";
import "./timeline.js";
import "./help.js";
import "./edit/placement.js";
import { stage } from "./commands.js";
import { connection } from "./connection.js";
import { homeOf } from "./navigation.js";
import { sharedValues } from "./share.js";
import { state } from "./state.js";

state.watch(["theme"], () => {
  const theme = state.get("theme");
  if (theme) document.documentElement.dataset.theme = theme;
  else document.documentElement.dataset.theme = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
});

state.watch(["hello", "train"], () => {
  const [hello, train] = [state.get("hello"), state.get("train")];
  if (!hello) return;
  const progress = train && train.phase !== "finished" ? `${Math.floor((100 * train.step) / Math.max(train.total, 1))} % · ` : "";
  document.title = `${progress}${hello.title} · Irradia`;
});

// The event of the server's scene comes after this one.
state.addEventListener("hello", () => stage().local?.connect(state.get("hello").server));

// The first scene determines the first camera; later versions keep it.
let placed = false;
state.watch(["scene", "views"], () => {
  const scene = state.get("scene");
  if (!scene || placed) return;
  placed = true;
  const { camera, pivot } = homeOf();
  const empty = scene.count === 0;
  state.set({ up: scene.up, camera, pivot, ...(empty && { frusta: true }), ...sharedValues() });
});

// Another address of the same page does not load it again.
addEventListener("hashchange", () => placed && state.set({ ...sharedValues() }));

connection.open();
