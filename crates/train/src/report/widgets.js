"use strict";
// Shared by the pages: text, a slider between two pictures, and charts.
const at = (id) => document.getElementById(id);
const make = (name, text, attributes = {}) => {
  const element = document.createElement(name);
  if (text !== undefined) element.textContent = text;
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
};

// Numbers that are not finite are null and are shown as a dash.
const known = (x) => typeof x === "number" && Number.isFinite(x);
const fixed = (x, digits) => (known(x) ? x.toFixed(digits) : "–");
const whole = (x) => (known(x) ? Math.round(x).toLocaleString("en") : "–");
const duration = (s) => {
  if (!known(s)) return "–";
  if (s < 60) return `${s.toFixed(1)} s`;
  const [minutes, rest] = [Math.floor(Math.round(s) / 60), Math.round(s) % 60];
  return minutes < 60 ? `${minutes} min ${rest} s` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
};
const bytes = (b) => (!b ? "–" : b < 1e9 ? `${Math.round(b / 1e6)} MB` : `${(b / 1e9).toFixed(1)} GB`);
const address = (path) => path.split("/").map(encodeURIComponent).join("/");

// A slider between two overlaid pictures; the second has the class "over".
const slider = (frame) => {
  let divide = 50;
  const slide = (percent) => {
    divide = Math.min(100, Math.max(0, percent));
    frame.style.setProperty("--at", `${divide}%`);
    frame.setAttribute("aria-valuenow", String(Math.round(divide)));
    frame.setAttribute("aria-valuetext", `${Math.round(divide)} percent of the left picture`);
  };
  const follow = (event) => {
    const box = frame.getBoundingClientRect();
    slide((100 * (event.clientX - box.left)) / box.width);
  };
  frame.addEventListener("pointerdown", (event) => {
    frame.setPointerCapture(event.pointerId);
    follow(event);
  });
  frame.addEventListener("pointermove", (event) => {
    if (frame.hasPointerCapture(event.pointerId)) follow(event);
  });
  frame.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 10 : 2;
    const to = { ArrowLeft: divide - step, ArrowDown: divide - step, ArrowRight: divide + step, ArrowUp: divide + step,
      PageDown: divide - 10, PageUp: divide + 10, Home: 0, End: 100 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    slide(to);
  });
  slide(50);
};

// Distinct in hue and lightness; lighter from the ninth on.
const HUES = [18, 198, 75, 275, 145, 330, 235, 45];
const color = (i) => `hsl(${HUES[i % HUES.length]} 62% ${i < HUES.length ? 46 : 66}%)`;

const svg = (name, attributes, text) => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
};
const short = (x) => {
  const size = Math.abs(x);
  if (size >= 1e6) return `${+(x / 1e6).toFixed(1)}M`;
  if (size >= 1e4) return `${+(x / 1e3).toFixed(1)}k`;
  return String(+x.toPrecision(3));
};
// Round numbers that divide low..high into at most as many parts.
const ticks = (low, high, parts = 4) => {
  const rough = (high - low) / parts, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough);
  const list = [];
  for (let number = Math.ceil(low / step - 1e-9); number * step <= high + step * 1e-9; number++) list.push(number * step);
  return list;
};

// Lines { color, points: [{ x, y }], name } in a box of width x height units that scales with the page.
const chart = (title, lines, { smooth = false, zero = false, digits = 0, unit = "", width = 340, height = 190,
  log = false, marks = [], legend = false, tell = (y) => `${fixed(y, digits)}${unit}` } = {}) => {
  const LEFT = 46, RIGHT = 8, TOP = 8, BOTTOM = 22;
  const box = make("div", undefined, { class: "curve" });
  const head = make("h3", title);
  const lone = lines.length === 1 ? lines[0].points : [];
  const last = lone.length ? tell(lone[lone.length - 1].y) : lines.length === 1 ? "–" : "";
  const output = make("output", last);
  head.append(output);
  box.append(head);
  const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${title} over the run` });
  box.append(picture);
  const all = lines.flatMap((line) => line.points.map((p) => ({ ...p, line })));
  if (all.length < 2) {
    const told = all.length ? `measured once, at ${all[0].x}` : "not measured during the run";
    picture.append(svg("text", { x: width / 2, y: height / 2, "text-anchor": "middle" }, told));
    return box;
  }
  const [xs, ys] = [all.map((p) => p.x), all.map((p) => p.y)];
  const span = (list) => [list.reduce((a, b) => Math.min(a, b)), list.reduce((a, b) => Math.max(a, b))];
  const [x0, x1] = span(xs);
  const place = log ? (y) => Math.log10(y) : (y) => y;
  let [y0, y1] = span(ys.map(place));
  // One extreme first value must not flatten the rest.
  if (smooth) y1 = Math.min(y1, [...ys].sort((a, b) => a - b)[Math.floor(0.99 * (ys.length - 1))] * 1.25);
  if (zero) y0 = 0;
  if (y1 <= y0) y1 = y0 + (Math.abs(y0) || 1);
  const px = (x) => LEFT + ((x - x0) / (x1 - x0 || 1)) * (width - LEFT - RIGHT);
  const py = (y) => height - BOTTOM - ((Math.min(place(y), y1) - y0) / (y1 - y0)) * (height - TOP - BOTTOM);
  for (const x of marks.filter((x) => x > x0 && x < x1)) {
    picture.append(svg("line", { x1: px(x), x2: px(x), y1: TOP, y2: height - BOTTOM, class: "mark" }));
  }
  const levels = ticks(y0, y1, height / 46).filter((y) => !log || Number.isInteger(+y.toFixed(6)));
  for (const y of log ? levels.map((power) => 10 ** power) : levels) {
    picture.append(svg("line", { x1: LEFT, x2: width - RIGHT, y1: py(y), y2: py(y), class: "grid" }));
    picture.append(svg("text", { x: LEFT - 6, y: py(y) + 4, "text-anchor": "end" }, log ? y.toExponential(0) : short(y)));
  }
  const steps = x1 > x0 ? ticks(x0, x1, width / 70) : [x0];
  steps.forEach((x) => {
    const anchor = px(x) > width - 24 ? "end" : "middle";
    picture.append(svg("text", { x: px(x), y: height - 6, "text-anchor": anchor }, short(x)));
  });
  const path = (list) => `M${list.map((p) => `${px(p.x).toFixed(1)} ${py(p.y).toFixed(1)}`).join("L")}`;
  for (const { color, points } of lines) {
    if (!points.length) continue;
    const style = `stroke: ${color}`;
    if (smooth && points.length > 40) {
      picture.append(svg("path", { d: path(points), class: "raw", style }));
      const reach = Math.ceil(points.length / 40);
      const means = points.map((p, index) => {
        const part = points.slice(Math.max(0, index - reach), index + reach + 1);
        return { x: p.x, y: part.reduce((sum, q) => sum + q.y, 0) / part.length };
      });
      picture.append(svg("path", { d: path(means), style }));
    } else picture.append(svg("path", { d: path(points), style }));
  }
  const cursor = svg("line", { y1: TOP, y2: height - BOTTOM, class: "cursor", visibility: "hidden" });
  picture.append(cursor);
  picture.addEventListener("pointermove", (event) => {
    const frame = picture.getBoundingClientRect();
    const x = ((event.clientX - frame.left) / frame.width) * width;
    const y = ((event.clientY - frame.top) / frame.height) * height;
    // With a single line the height does not matter.
    const far = (p) => Math.abs(px(p.x) - x) + (lines.length > 1 ? Math.abs(py(p.y) - y) : 0);
    const near = all.reduce((a, b) => (far(b) < far(a) ? b : a));
    cursor.setAttribute("x1", px(near.x));
    cursor.setAttribute("x2", px(near.x));
    cursor.setAttribute("visibility", "visible");
    const name = near.line.name ? `${near.line.name} ` : "";
    output.textContent = `${name}${tell(near.y)} at ${short(near.x)}`;
  });
  picture.addEventListener("pointerleave", () => {
    cursor.setAttribute("visibility", "hidden");
    output.textContent = last;
  });
  if (legend) {
    const list = make("p", undefined, { class: "legend" });
    for (const { name, color } of lines) {
      const item = make("span");
      item.append(make("span", undefined, { class: "swatch", style: `background: ${color}` }), name);
      list.append(item);
    }
    box.append(list);
  }
  return box;
};
