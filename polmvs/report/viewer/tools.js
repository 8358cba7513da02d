// Tools of the 3D view: the distance of two points, and the box of the option --box.
import { BufferAttribute, BufferGeometry, LineBasicMaterial, LineSegments, Matrix4, Vector3 } from "three";
import { forEachProjected, pickPoint, worldPoint } from "./picking.js";

const COLOR = 0x00bcd4; // of lines that are drawn over a surface
const CROSS = 0.02; // arm of the cross at a chosen point, in radii of the part
const PAD = 0.01; // of a box beyond what was chosen, share of its diagonal
const SURFACE_KINDS = [0, 4]; // of points: the part, as it is seen and as it is inferred
const CLICK_PX = 5; // a pointer that moves farther drags

export class Tools {
  constructor(view) {
    this.view = view;
    this.mode = "";
    this.points = [];
    this.box = null; // { low: [x, y, z], high } in the chosen frame
    this.frame = 0;
    const root = view.root;
    this.buttons = [...root.querySelectorAll("[data-tool]")];
    this.measured = root.querySelector("[data-panel=measure]");
    this.cropping = root.querySelector("[data-panel=box]");
    this.frames = root.querySelector("[data-control=frame]");
    this.edges = [...root.querySelectorAll("[data-edge]")];
    this.text = root.querySelector("[data-control=option]");
    view.description.frames.forEach((frame, i) => this.frames.add(new Option(frame.label, String(i))));
    this.frames.closest("label").hidden = view.description.frames.length < 2;
    this.buttons.forEach((button) =>
      button.addEventListener("click", () => this.choose(this.mode === button.dataset.tool ? "" : button.dataset.tool)),
    );
    this.frames.addEventListener("change", () => {
      this.frame = Number(this.frames.value);
      this.box = this.chosen ? this.boxOf(this.chosen) : null;
      this.show();
    });
    this.edges.forEach((edge) => edge.addEventListener("input", () => this.edit()));
    root.querySelector("[data-control=copy]").addEventListener("click", (event) => this.copy(event.target));
    root.querySelector("[data-control=nobox]").addEventListener("click", () => this.clear());
    root.querySelector("[data-control=nopoints]").addEventListener("click", () => this.clear());
    this.show();
  }

  bind(pane) {
    let start = null;
    const place = (event) => {
      const bounds = pane.canvas.getBoundingClientRect();
      return [event.clientX - bounds.left, event.clientY - bounds.top];
    };
    pane.canvas.addEventListener("pointerdown", (event) => {
      start = event.button === 0 ? place(event) : null;
    });
    pane.canvas.addEventListener("pointermove", (event) => {
      if (start && this.mode === "box") pane.band(start, place(event));
    });
    pane.canvas.addEventListener("pointerup", (event) => {
      if (!start || event.button !== 0) return;
      const [first, last] = [start, place(event)];
      start = null;
      pane.band(null);
      if (Math.hypot(last[0] - first[0], last[1] - first[1]) <= CLICK_PX) this.click(pane, ...last);
      else if (this.mode === "box") this.drag(pane, first, last);
    });
    pane.canvas.addEventListener("pointercancel", () => {
      start = null;
      pane.band(null);
    });
  }

  choose(mode) {
    this.mode = mode;
    this.points = [];
    if (mode !== "box") this.box = this.chosen = null;
    this.show();
  }

  clear() {
    this.points = [];
    this.box = this.chosen = null;
    this.show();
  }

  // A click, or Enter for the middle of the pane; whether a tool made use of it.
  click(pane, x, y) {
    if (!this.mode) return this.view.clickCamera(pane, x, y);
    const point = pickPoint(pane, x, y);
    if (!point) {
      this.say("There is no surface here: choose a place on the part.");
      return true;
    }
    this.points = this.points.length === 2 ? [point] : [...this.points, point];
    if (this.mode === "box") {
      this.chosen = this.points.length === 2 ? this.between(pane) : null;
      this.box = this.chosen && this.boxOf(this.chosen);
    }
    this.show();
    return true;
  }

  // The surface inside a rectangle of the pane.
  drag(pane, first, last) {
    const [left, right] = [Math.min(first[0], last[0]), Math.max(first[0], last[0])];
    const [top, bottom] = [Math.min(first[1], last[1]), Math.max(first[1], last[1])];
    const part = this.surface(pane);
    const inside = [];
    forEachProjected(pane, (index, x, y) => {
      if (x >= left && x <= right && y >= top && y <= bottom && part(index)) inside.push(index);
    });
    this.points = [];
    this.chosen = inside.length > 1 ? inside.map((index) => worldPoint(pane, index)) : null;
    this.box = this.chosen && this.boxOf(this.chosen);
    this.show();
    if (!this.box) this.say("The rectangle holds no surface.");
  }

  // Two corners lie on a surface, and the box between them may be thin: along its shortest edge it
  // takes what lies between the others.
  between(pane) {
    const frame = this.matrix();
    const [low, high] = extent(this.points.map((point) => point.clone().applyMatrix4(frame)));
    const sizes = high.map((value, axis) => value - low[axis]);
    const thin = sizes.indexOf(Math.min(...sizes));
    const part = this.surface(pane);
    const num = pane.object.geometry.getAttribute("position").count;
    const found = [...this.points];
    for (let index = 0; index < num; index++) {
      if (!part(index)) continue;
      const point = worldPoint(pane, index);
      const local = point.clone().applyMatrix4(frame).toArray();
      if (local.every((value, axis) => axis === thin || (value >= low[axis] && value <= high[axis]))) found.push(point);
    }
    return found;
  }

  // Whether a vertex is of the part; all are where no kind is known.
  surface(pane) {
    const kind = pane.built.channels.kind;
    if (!kind) return () => true;
    const classes = this.view.description.channels.kind.classes.length;
    const of = (index) => Math.floor((kind.array[index] * classes) / 256);
    let some = false;
    for (let i = 0; i < kind.count && !some; i++) some = SURFACE_KINDS.includes(of(i));
    return some ? (index) => SURFACE_KINDS.includes(of(index)) : () => true;
  }

  matrix() {
    return new Matrix4().set(...this.view.description.frames[this.frame].matrix);
  }

  boxOf(points) {
    const frame = this.matrix();
    const [low, high] = extent(points.map((point) => point.clone().applyMatrix4(frame)));
    const pad = PAD * Math.hypot(...high.map((value, axis) => value - low[axis])) || this.view.description.radius * PAD;
    const step = this.step();
    return {
      low: low.map((value) => Math.floor((value - pad) / step) * step),
      high: high.map((value) => Math.ceil((value + pad) / step) * step),
    };
  }

  // Of the numbers of a box: a thousandth of the part or finer.
  step() {
    return 10 ** Math.floor(Math.log10(this.view.description.radius / 500));
  }

  edit() {
    const values = this.edges.map((edge) => edge.valueAsNumber);
    if (values.some((value) => !Number.isFinite(value))) return;
    this.box = { low: values.slice(0, 3), high: values.slice(3) };
    this.chosen = null;
    this.show(false);
  }

  // The text of the option, as the command line takes it.
  option() {
    const digits = Math.max(0, -Math.floor(Math.log10(this.step())));
    const numbers = [...this.box.low, ...this.box.high].map((value) => String(Number(value.toFixed(digits))));
    const { option } = this.view.description.frames[this.frame];
    return `--box=${numbers.join(",")}${option ? ` ${option}` : ""}`;
  }

  async copy(button) {
    const label = button.textContent;
    try {
      await navigator.clipboard.writeText(this.text.value);
    } catch {
      this.text.select(); // a page from disk may have no clipboard
      document.execCommand("copy");
    }
    button.textContent = "Copied";
    setTimeout(() => (button.textContent = label), 1500);
  }

  say(text) {
    const panel = this.mode === "box" ? this.cropping : this.measured;
    panel.querySelector("output").textContent = text;
  }

  show(fill = true) {
    const { view, mode } = this;
    this.buttons.forEach((button) => button.setAttribute("aria-pressed", String(button.dataset.tool === mode)));
    this.measured.hidden = mode !== "measure";
    this.cropping.hidden = mode !== "box";
    (view.panes || []).forEach((pane) => {
      pane.element.dataset.tool = mode;
      pane.controls.noRotate = mode === "box";
    });
    if (mode === "measure") this.say(this.distance());
    if (mode === "box") {
      this.text.value = this.box ? this.option() : "";
      if (fill) {
        const step = this.step();
        const digits = Math.max(0, -Math.floor(Math.log10(step)));
        this.edges.forEach((edge, i) => {
          edge.step = String(Number(step.toPrecision(1)));
          edge.value = this.box ? (i < 3 ? this.box.low[i] : this.box.high[i - 3]).toFixed(digits) : "";
        });
      }
      this.say(this.box ? this.size() : this.points.length ? "Now the opposite corner." : "Drag a rectangle over the part, or click two opposite corners.");
    }
    view.compose();
  }

  distance() {
    if (this.points.length < 2) return this.points.length ? "Now the second point." : "Click two points of the surface.";
    const [one, two] = this.points;
    const away = two.clone().sub(one);
    return `Distance ${this.length(away.length())}; along x, y, z of the model ${away.toArray().map((value) => this.length(value)).join(", ")}`;
  }

  size() {
    const sides = this.box.high.map((value, axis) => this.length(value - this.box.low[axis]));
    return `The box is ${sides.join(" by ")}. Places outside are dimmed.`;
  }

  length(value) {
    const { factor, name } = this.view.description.unit;
    return `${Number((factor * value).toPrecision(4))} ${name}`;
  }

  // What is drawn over the surface.
  lines() {
    const ends = [];
    const add = (...points) => points.forEach((point) => ends.push(...point.toArray()));
    const arm = CROSS * this.view.description.radius;
    for (const point of this.points) {
      for (const axis of [new Vector3(arm, 0, 0), new Vector3(0, arm, 0), new Vector3(0, 0, arm)]) {
        add(point.clone().sub(axis), point.clone().add(axis));
      }
    }
    if (this.mode === "measure" && this.points.length === 2) add(...this.points);
    if (this.box) {
      const back = this.matrix().invert();
      const corner = (i) =>
        new Vector3(...[0, 1, 2].map((axis) => (i & (1 << axis) ? this.box.high : this.box.low)[axis])).applyMatrix4(back);
      for (let i = 0; i < 8; i++) for (const bit of [1, 2, 4]) if (!(i & bit)) add(corner(i), corner(i | bit));
    }
    if (!ends.length) return null;
    const lines = new LineSegments(
      new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(ends), 3)),
      new LineBasicMaterial({ color: COLOR, depthTest: false, transparent: true }),
    );
    lines.frustumCulled = false;
    lines.renderOrder = 1;
    return lines;
  }
}

function extent(points) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (const point of points) {
    point.toArray().forEach((value, axis) => {
      low[axis] = Math.min(low[axis], value);
      high[axis] = Math.max(high[axis], value);
    });
  }
  return [low, high];
}
