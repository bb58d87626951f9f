// <irr-chart>: curves over the steps of a training.

/** @typedef {{ name: string, color: string, points: [number, number][] }} Curve */

class Chart extends HTMLElement {
  /** @type {Curve[]} */
  curves = [];
  total = 1;
  logarithmic = false;

  connectedCallback() {
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.append(this.canvas);
    new ResizeObserver(() => this.draw()).observe(this);
  }

  /** @param {Curve[]} curves @param {number} total steps @param {boolean} logarithmic */
  show(curves, total, logarithmic) {
    Object.assign(this, { curves, total: Math.max(total, 1), logarithmic });
    const last = (/** @type {Curve} */ { name, points }) => `${name} ${points.at(-1)?.[1].toPrecision(4) ?? "unknown"}`;
    this.canvas?.setAttribute("aria-label", curves.map(last).join(", "));
    this.draw();
  }

  draw() {
    const canvas = this.canvas;
    if (!canvas || !canvas.clientWidth) return;
    const density = devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const [w, h] = [Math.round(width * density), Math.round(height * density)];
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    // Small and rarely drawn: the GPU is not worth it.
    const context = canvas.getContext("2d", { willReadFrequently: true });
    if (!context) return;
    context.setTransform(density, 0, 0, density, 0, 0);
    context.clearRect(0, 0, width, height);
    const scaled = (/** @type {number} */ value) => (this.logarithmic ? Math.log10(Math.max(value, 1e-9)) : value);
    const values = this.curves.flatMap(({ points }) => points.map(([, value]) => scaled(value))).filter(Number.isFinite).sort((a, b) => a - b);
    if (values.length === 0) return;
    // Outliers at the beginning would flatten the rest.
    const [low, high] = [values[0], values[Math.floor(0.995 * (values.length - 1))]];
    const span = Math.max(high - low, 1e-6);
    const style = getComputedStyle(this);
    const [left, right, top, bottom] = [34, 2, 4, 14];
    const x = (/** @type {number} */ step) => left + ((width - left - right) * step) / this.total;
    const y = (/** @type {number} */ value) => top + (height - top - bottom) * (1 - (scaled(value) - low) / span);
    context.font = "10px system-ui";
    context.fillStyle = style.getPropertyValue("--quiet");
    context.strokeStyle = style.getPropertyValue("--line");
    context.textAlign = "right";
    for (const share of [0, 0.5, 1]) {
      const value = low + share * span;
      const at = top + (height - top - bottom) * (1 - share);
      context.beginPath();
      context.moveTo(left, at + 0.5);
      context.lineTo(width - right, at + 0.5);
      context.stroke();
      context.fillText((this.logarithmic ? 10 ** value : value).toPrecision(3), left - 4, at + 3);
    }
    context.textAlign = "left";
    context.fillText("0", left, height - 3);
    context.textAlign = "right";
    context.fillText(`${this.total}`, width - right, height - 3);
    for (const { color, points } of this.curves) {
      context.strokeStyle = context.fillStyle = color.startsWith("--") ? style.getPropertyValue(color) : color;
      context.lineWidth = 1.4;
      context.beginPath();
      for (const [step, value] of points) context.lineTo(x(step), Math.max(y(value), top));
      context.stroke();
      const last = points.at(-1);
      if (last) context.fillRect(x(last[0]) - 1.5, Math.max(y(last[1]), top) - 1.5, 3, 3);
    }
  }
}

customElements.define("irr-chart", Chart);
export { Chart };
