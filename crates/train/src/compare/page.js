
(() => {
  const comparison = JSON.parse(at("data").textContent);
  const colored = (name, i) => {
    const cell = make("td");
    const label = make("span", undefined, { class: "recipe" });
    label.append(make("span", undefined, { class: "swatch", style: `background: ${color(i)}` }), make("span", name));
    cell.append(label);
    return cell;
  };
  const row = (cells, kind = "td") => {
    const line = make("tr");
    for (const cell of cells) line.append(cell instanceof Node ? cell : make(kind, cell));
    return line;
  };
  const table = (heads, lines, attributes = {}) => {
    const [element, head, body] = [make("table", undefined, attributes), make("thead"), make("tbody")];
    head.append(row(heads, "th"));
    body.append(...lines);
    element.append(head, body);
    return element;
  };
  const scrolled = (element) => {
    const box = make("div", undefined, { class: "scroll" });
    box.append(element);
    return box;
  };

  document.title = "Comparison – Irradia";
  at("version").textContent = comparison.version;
  const names = comparison.scenes.map((scene) => scene.name);
  at("title").textContent = names.length === 1 ? `Recipes on ${names[0]}` : "Recipes compared";
  at("subtitle").textContent = comparison.conditions.join(" · ");
  for (const note of comparison.notes) at("notes").append(make("li", note));
  const { cpu, memory, os } = comparison.machine;
  at("where").textContent = [comparison.device, cpu, memory && bytes(memory), os].filter(Boolean).join(" · ");

  const runs = comparison.scenes.flatMap((scene) => scene.entries).flatMap((entry) => entry.runs);
  const nets = [...new Set(runs.map((run) => run.figures && run.figures.lpips_net).filter(Boolean))].sort();
  const lpips = nets.length ? `LPIPS (${nets.join(", ")})` : "LPIPS";
  const unseenNets = [...new Set(runs.map((run) => run.figures && run.figures.unseen_lpips_net).filter(Boolean))].sort();
  const unseen = `LPIPS (${unseenNets.join(", ")})`;

  // Mean and spread; the best mean of a column is bold if more than one recipe has one.
  const MEASURES = [
    ["PSNR, dB", "psnr", (x) => fixed(x, 2), 1],
    ["SSIM", "ssim", (x) => fixed(x, 4), 1],
    [lpips, "lpips", (x) => fixed(x, 4), -1],
    [unseen, "unseen_lpips", (x) => fixed(x, 4), -1],
    ["Training, s", "seconds", (x) => fixed(x, 1), -1],
    ["CPU, s", "cpu_seconds", (x) => fixed(x, 1), -1],
    ["Splats", "splats", whole, 0],
    ["Parameters", "parameters", whole, 0],
    ["Memory", "peak_memory", bytes, 0],
    ["Loss rises", "loss_rises", (x) => `${fixed(100 * x, 0)} %`, -1],
    ["Error rises", "error_rises", (x) => `${fixed(100 * x, 0)} %`, -1],
    ["PSNR falls", "psnr_falls", (x) => `${fixed(100 * x, 0)} %`, -1],
  ];
  const figures = (entries) => {
    const shown = MEASURES.filter(([, key]) => entries.some((entry) => entry[key]));
    const best = shown.map(([, key, , better]) => {
      const means = entries.filter((entry) => entry[key]).map((entry) => better * entry[key].mean);
      return better && means.length > 1 ? Math.max(...means) : NaN;
    });
    const lines = entries.map((entry, i) => {
      const done = entry.runs.filter((run) => run.figures).length;
      const cells = shown.map(([, key, text, better], column) => {
        const spread = entry[key];
        const cell = make("td", spread ? text(spread.mean) : "–");
        if (spread && known(spread.deviation)) cell.append(make("small", `± ${text(spread.deviation)}`));
        if (spread && better * spread.mean === best[column]) cell.classList.add("best");
        return cell;
      });
      return row([colored(entry.recipe, i), ...cells, `${done} of ${entry.runs.length}`]);
    });
    const failed = entries.flatMap((entry) =>
      entry.runs.filter((run) => run.error).map((run) => {
        const cell = make("td", run.error, { class: "error", colspan: String(shown.length + 1) });
        return row([`${entry.recipe}, seed ${run.seed}`, cell]);
      }));
    return table(["Recipe", ...shown.map(([head]) => head), "Runs"], [...lines, ...failed], { class: "dense" });
  };

  // Every run is a thin line in its recipe's colour, over steps or seconds.
  const curves = (entries, axis, title) =>
    chart(title, entries.flatMap((entry, i) =>
      entry.runs.filter((run) => run.figures).map((run) => ({
        name: entry.runs.length > 1 ? `${entry.recipe}, seed ${run.seed}:` : `${entry.recipe}:`,
        color: color(i),
        points: run.figures.looks.filter((p) => known(p[axis]) && known(p.psnr)).map((p) => ({ x: p[axis], y: p.psnr })),
      }))), { digits: 2, unit: " dB", width: 520, height: 280 });

  const times = (entries, key, text) => {
    const levels = entries[0].reached.map((_, i) => i);
    const finished = entries.map((entry) => entry.runs.filter((run) => run.figures).length);
    const fastest = levels.map((i) => Math.min(...entries.map((entry) => entry.reached[i][key]?.mean ?? Infinity)));
    const lines = entries.map((entry, e) =>
      row([colored(entry.recipe, e), ...levels.map((i) => {
        const spread = entry.reached[i][key];
        const cell = make("td", spread ? text(spread.mean) : "–");
        if (spread && spread.runs < finished[e]) cell.append(make("small", `${spread.runs} of ${finished[e]}`));
        if (spread && entries.length > 1 && spread.mean === fastest[i]) cell.classList.add("best");
        return cell;
      })]));
    return table(["Recipe", ...levels.map((i) => entries[0].reached[i].psnr.toFixed(1))], lines, { class: "dense" });
  };

  // When each recipe reaches the first one's final PSNR, also as a fraction of the first one's whole time.
  const toMark = (entries) => {
    const lines = entries.map((entry, i) => {
      const finished = entry.runs.filter((run) => run.figures).length;
      const { seconds, steps } = entry.to_mark;
      const cells = [[seconds, (x) => fixed(x, 1)], [steps, whole]].map(([spread, text]) => {
        const cell = make("td", spread ? text(spread.mean) : "–");
        if (spread && known(spread.deviation)) cell.append(make("small", `± ${text(spread.deviation)}`));
        return cell;
      });
      return row([colored(entry.recipe, i), ...cells, known(entry.mark_share) ? `${fixed(100 * entry.mark_share, 0)} %` : "–",
        `${seconds ? seconds.runs : 0} of ${finished}`]);
    });
    return table(["Recipe", "Seconds", "Steps", "Fraction of the first one's whole time", "Runs that reach it"], lines, { class: "dense" });
  };

  const pictures = (scene) => {
    const { view } = scene;
    const all = [{ name: "photograph", picture: view.truth, caption: "photograph" }];
    view.renders.forEach((render, i) => {
      const name = scene.entries[i].recipe;
      if (render) all.push({ name, picture: render.picture, caption: `${name}, seed ${render.seed}: ${fixed(render.psnr, 2)} dB` });
    });
    const sides = make("div", undefined, { class: "sides" });
    for (const { picture, caption } of all) {
      const figure = make("figure");
      figure.append(make("img", undefined, { src: picture, alt: caption }), make("figcaption", caption));
      sides.append(figure);
    }
    const divided = make("div", undefined, { class: "divided" });
    const frame = make("div", undefined, { class: "compare", role: "slider", tabindex: "0",
      "aria-label": "Divide between two pictures", "aria-valuemin": "0", "aria-valuemax": "100" });
    const images = ["", "over"].map((kind) => make("img", undefined, { class: kind, draggable: "false", alt: "" }));
    frame.append(...images, make("span", undefined, { class: "handle", "aria-hidden": "true" }));
    const picker = make("div", undefined, { class: "picker" });
    ["Left of the line", "Right of the line"].forEach((text, side) => {
      const label = make("label", text);
      const select = make("select");
      all.forEach(({ name }, i) => select.append(make("option", name, { value: String(i) })));
      const show = () => {
        images[side].src = all[Number(select.value)].picture;
        images[side].alt = all[Number(select.value)].name;
      };
      select.value = String(side ? all.length - 1 : 0);
      select.addEventListener("change", show);
      show();
      label.append(make("br"), select);
      picker.append(label);
    });
    slider(frame);
    divided.append(frame, picker);
    return [sides, divided];
  };

  const size = (o) => (known(o.parameters) ? `${whole(o.parameters)} parameters` : whole(o.splats));
  if (comparison.overall.length && comparison.scenes.length > 1) {
    at("overall").hidden = false;
    const lines = comparison.overall.map((o, i) =>
      row([colored(o.recipe, i), fixed(o.psnr, 2), fixed(o.ssim, 4), fixed(o.lpips, 4), fixed(o.seconds, 1), size(o),
        ...[o.marks, o.marks_in_a_third].map((n) => (i ? `${n} of ${o.scenes}` : "–"))]));
    at("overall-table").replaceWith(table(["Recipe", "PSNR, dB", "SSIM", lpips, "Training, s", "Splats", "Reaches the first",
      "In a third of its time"], lines));
    at("overall-note").textContent =
      `Means over the ${comparison.overall[0].scenes} scenes on which every recipe has figures, of the means over seeds. ` +
      "Reaches the first: scenes on which all runs reach the first recipe's final PSNR.";
  }
  for (const scene of comparison.scenes) {
    const section = make("section", undefined, { class: "scene" });
    const part = (title, ...content) => section.append(make("h3", title, { class: "part" }), ...content);
    const theirs = comparison.published.filter((p) => p.scene === scene.name);
    section.append(make("h2", scene.name), make("p", scene.data, { class: "soft" }));
    section.append(scrolled(figures(scene.entries)));
    section.append(make("p", "Mean ± sample standard deviation over seeds. Loss rises: fraction of blocks of 25 logged steps (of fewer " +
      "in short runs) whose mean training loss is above that of the previous block. Error rises: the same for the mean squared error of the " +
      "training views, which is comparable between recipes. PSNR falls: fraction of evaluations of the held-out " +
      "views with a lower PSNR than the previous one.", { class: "note" }));
    if (theirs.length) {
      const lines = theirs.map((p) => row([p.method, fixed(p.psnr, 2), fixed(p.ssim, 3), fixed(p.lpips_vgg, 3), p.source]));
      part("Published figures", scrolled(table(["Method", "PSNR, dB", "SSIM", "LPIPS (vgg)", "Source"], lines)));
    }
    if (scene.entries.some((entry) => entry.psnr)) {
      const both = make("div", undefined, { class: "two" });
      both.append(curves(scene.entries, "seconds", "Held-out PSNR over seconds of training"),
        curves(scene.entries, "step", "Held-out PSNR over steps"));
      part("Curves", both);
      if (scene.mark) {
        part(`Time until a recipe reaches the final PSNR of ${scene.entries[0].recipe}: ${fixed(scene.mark.psnr, 2)} dB, ` +
          `after ${fixed(scene.mark.seconds, 1)} s`, scrolled(toMark(scene.entries)));
      }
      part("Seconds of training until a held-out PSNR (dB) is reached", scrolled(times(scene.entries, "seconds", (x) => fixed(x, 1))));
      part("Steps until it is reached", scrolled(times(scene.entries, "steps", whole)));
    }
    if (scene.view) part(`Held-out view ${scene.view.name}`, ...pictures(scene));
    at("main").append(section);
  }
})();
