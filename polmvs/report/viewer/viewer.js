// The 3D view of a report: clouds and meshes of one scene, in one or two panes that share a camera.
//
// The page holds a JSON description (#scene) and one gzipped, base64-coded block of bytes for each
// layer (#layer-N). Positions are 16-bit shares of the scene's box, normals 8-bit, every further
// channel one byte a point with the range it stands for. Nothing is loaded from anywhere.
import {
  BufferAttribute,
  BufferGeometry,
  Color,
  ColorManagement,
  DataTexture,
  DoubleSide,
  LinearSRGBColorSpace,
  Matrix3,
  Matrix4,
  Mesh,
  PerspectiveCamera,
  Points,
  Quaternion,
  Scene,
  ShaderMaterial,
  Vector3,
  WebGLRenderer,
} from "three";
import { TrackballControls } from "three/examples/jsm/controls/TrackballControls.js";
import { Cameras, standIn } from "./cameras.js";
import { Tools } from "./tools.js";

// Colours are those of the page's legend all the way to the screen: no conversion on the way in,
// none on the way out.
ColorManagement.enabled = false;

const TYPES = { uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, uint32: Uint32Array };
const TURN = 0.12; // rad for each press of an arrow key
const FIELD_DEG = 40;
const MODES = { palette: 0, normal: 1, grey: 2 };
const SHADING = 0.6; // how far slanted places are darkened where shading is chosen
const LEGEND_STOPS = 33; // of a bar; between them a colour map is straight to 1 of 255

const VERTEX = `
attribute float value;
uniform float pointSize;
uniform mat4 boxFrame;
varying vec3 vInBox;
varying float vValue;
varying vec3 vNormal;
varying vec3 vWorldNormal;
varying vec3 vEye;
void main() {
  vec4 inCamera = modelViewMatrix * vec4(position, 1.0);
  vValue = value;
  vWorldNormal = normal;
  vNormal = mat3(viewMatrix) * normal;
  vEye = inCamera.xyz;
  vInBox = (boxFrame * modelMatrix * vec4(position, 1.0)).xyz;
  gl_Position = projectionMatrix * inCamera;
  gl_PointSize = max(1.5, pointSize / -inCamera.z);
}`;

const FRAGMENT = `
uniform sampler2D palette;
uniform int mode;
uniform float shading;
uniform bool isPoint;
uniform mat3 basis;
uniform bool boxed;
uniform vec3 boxLow;
uniform vec3 boxHigh;
uniform vec3 ground;
varying vec3 vInBox;
varying float vValue;
varying vec3 vNormal;
varying vec3 vWorldNormal;
varying vec3 vEye;
void main() {
  if (isPoint && length(gl_PointCoord - 0.5) > 0.5) discard;
  vec3 color = mode == 2 ? vec3(vValue)
    : mode == 1 ? (length(vWorldNormal) > 0.1 ? 0.5 + 0.5 * basis * normalize(vWorldNormal) : vec3(0.6))
    : texture2D(palette, vec2((vValue * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  float size = length(vNormal);
  float facing = size > 0.1 ? abs(dot(vNormal / size, normalize(vEye))) : 0.8;
  color *= mix(1.0, 0.3 + 0.7 * facing, shading);
  bool outside = boxed && (any(lessThan(vInBox, boxLow)) || any(greaterThan(vInBox, boxHigh)));
  gl_FragColor = vec4(outside ? mix(ground, color, 0.15) : color, 1.0);
}`;

async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// With a colour of what is unknown the last place is its, and the others are the scale's.
function paletteTexture(colors, unknown) {
  const bytes = new Uint8Array(256 * 4);
  const places = unknown ? 255 : 256;
  for (let i = 0; i < 256; i++) {
    const place = Math.min(colors.length - 1, Math.floor((i * colors.length) / places));
    const color = new Color(i < places ? colors[place] : unknown);
    const rounded = [color.r, color.g, color.b].map((share) => Math.round(255 * share));
    bytes.set([...rounded, 255], 4 * i);
  }
  const texture = new DataTexture(bytes, 256, 1);
  texture.needsUpdate = true;
  return texture;
}

async function buildLayer(layer, scene) {
  const buffer = await unpack(document.getElementById(layer.data).textContent.trim());
  const array = (part) => new TYPES[part.type](buffer, part.offset, part.length);
  const geometry = new BufferGeometry();
  const position = new BufferAttribute(array(layer.position), 3, true);
  geometry.setAttribute("position", position);
  geometry.setAttribute("normal", new BufferAttribute(array(layer.normal), 3, true));
  const channels = {};
  for (const [name, part] of Object.entries(layer.channels)) {
    channels[name] = new BufferAttribute(array(part), 1, true);
  }
  geometry.setAttribute("value", channels[Object.keys(channels)[0]]);
  if (layer.triangles) geometry.setIndex(new BufferAttribute(array(layer.triangles), 1));
  const material = new ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    side: DoubleSide,
    uniforms: {
      palette: { value: null },
      mode: { value: MODES.grey },
      pointSize: { value: 1 },
      shading: { value: 0 },
      isPoint: { value: !layer.triangles },
      basis: { value: new Matrix3().set(...scene.basis) },
      boxed: { value: false },
      boxFrame: { value: new Matrix4() },
      boxLow: { value: new Vector3() },
      boxHigh: { value: new Vector3() },
      ground: { value: new Color() },
    },
  });
  const object = layer.triangles ? new Mesh(geometry, material) : new Points(geometry, material);
  object.position.fromArray(scene.origin);
  object.scale.setScalar(scene.extent);
  object.frustumCulled = false;
  return { layer, object, channels };
}

class Pane {
  constructor(element, view) {
    this.view = view;
    this.element = element;
    this.canvas = element.querySelector("canvas");
    this.select = element.querySelector("select");
    this.renderer = new WebGLRenderer({ canvas: this.canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    this.scene = new Scene();
    view.description.layers.forEach((layer, i) => this.select.add(new Option(layer.label, String(i))));
    this.select.addEventListener("change", () => this.show(Number(this.select.value)));
    this.controls = new TrackballControls(view.camera, this.canvas);
    this.controls.target.fromArray(view.description.target);
    this.controls.staticMoving = true;
    this.controls.rotateSpeed = 3;
    this.controls.addEventListener("change", () => view.draw());
    this.canvas.addEventListener("pointermove", () => this.follow());
    this.canvas.addEventListener("wheel", () => this.follow(), { passive: true });
    this.canvas.addEventListener("keydown", (event) => view.key(event, this));
    view.tools.bind(this);
  }

  // The rectangle that is being dragged, between two places of the canvas; none without.
  band(first, last) {
    const band = this.element.querySelector(".band");
    band.hidden = !first;
    if (!first) return;
    band.style.left = `${Math.min(first[0], last[0])}px`;
    band.style.top = `${Math.min(first[1], last[1])}px`;
    band.style.width = `${Math.abs(last[0] - first[0])}px`;
    band.style.height = `${Math.abs(last[1] - first[1])}px`;
  }

  compose() {
    this.scene.clear();
    if (this.object) this.scene.add(this.object);
    this.view.cameras.drawn().forEach((lines) => this.scene.add(lines));
    const lines = this.view.tools.lines();
    if (lines) this.scene.add(lines);
    this.paint();
  }

  follow() {
    this.controls.update();
    this.view.panes.forEach((other) => other.controls.target.copy(this.controls.target));
    this.view.draw();
  }

  async show(index) {
    this.index = index;
    this.select.value = String(index);
    const built = await this.view.layer(index);
    if (this.index !== index) return;
    // Each pane has its own copy of the object, of the same arrays.
    this.object = built.object.clone();
    this.object.geometry = built.object.geometry.clone();
    this.object.material = built.object.material.clone();
    this.built = built;
    this.compose();
    this.element.dataset.layer = built.layer.label;
    this.element.dataset.points = String(built.layer.count);
    this.view.draw();
  }

  paint() {
    if (!this.object) return;
    const uniforms = this.object.material.uniforms;
    const name = this.view.color;
    const channel = this.view.description.channels[name];
    const has = name === "normal" || name in this.built.channels;
    const values = has && name !== "normal" ? this.built.channels[name] : Object.values(this.built.channels)[0];
    this.object.geometry.setAttribute("value", values);
    uniforms.mode.value = name === "normal" ? MODES.normal : has && channel.colors ? MODES.palette : MODES.grey;
    uniforms.palette.value = has && channel.colors ? this.view.palette(name) : this.view.blank;
    uniforms.shading.value = this.view.shaded ? SHADING : 0;
    const { box } = this.view.tools;
    uniforms.boxed.value = Boolean(box);
    if (box) {
      uniforms.boxFrame.value.copy(this.view.tools.matrix());
      uniforms.boxLow.value.fromArray(box.low);
      uniforms.boxHigh.value.fromArray(box.high);
    }
    this.element.querySelector(".without").hidden = has;
  }

  draw() {
    const width = this.canvas.clientWidth;
    const height = this.canvas.clientHeight;
    if (!width || !height) return;
    const ratio = this.renderer.getPixelRatio();
    if (this.canvas.width !== Math.floor(width * ratio) || this.canvas.height !== Math.floor(height * ratio)) {
      this.renderer.setSize(width, height, false);
      this.controls.handleResize();
    }
    const camera = this.view.camera;
    camera.aspect = width / height;
    // The narrower side spans the field of view, so that a tall pane shows the whole part too.
    camera.fov = FIELD_DEG;
    if (this.view.through) {
      const [right, up] = this.view.through.half_field;
      camera.fov = (360 / Math.PI) * Math.atan(Math.max(up, right / camera.aspect));
    } else if (camera.aspect < 1) {
      const half = Math.tan((0.5 * FIELD_DEG * Math.PI) / 180) / camera.aspect;
      camera.fov = (360 / Math.PI) * Math.atan(half);
    }
    camera.updateProjectionMatrix();
    if (this.object) {
      const focal = (0.5 * height * ratio) / Math.tan((0.5 * camera.fov * Math.PI) / 180);
      this.object.material.uniforms.pointSize.value =
        3 * this.built.layer.spacing * focal * this.view.pointScale;
    }
    const ground = getComputedStyle(this.element).getPropertyValue("--canvas").trim() || "#ffffff";
    if (this.object) this.object.material.uniforms.ground.value.set(ground);
    this.renderer.setClearColor(ground, 1);
    this.renderer.render(this.scene, camera);
    this.element.dataset.frames = String(1 + Number(this.element.dataset.frames || 0));
  }
}

class View {
  constructor(root) {
    this.root = root;
    this.description = JSON.parse(document.getElementById("scene").textContent);
    this.built = new Map();
    this.textures = new Map();
    this.blank = paletteTexture(["#888888"]);
    this.color = this.description.color;
    this.pointScale = 1;
    this.shaded = false;
    this.camera = new PerspectiveCamera(FIELD_DEG, 1, 0.01 * this.description.radius, 100 * this.description.radius);
    this.through = null;
    this.cameras = new Cameras(this);
    this.tools = new Tools(this);
    this.reset();
    this.panes = [...root.querySelectorAll(".pane")].map((element) => new Pane(element, this));
    this.reset(); // the controls looked at the origin when they were made
    this.bind();
  }

  layer(index) {
    if (!this.built.has(index)) this.built.set(index, buildLayer(this.description.layers[index], this.description));
    return this.built.get(index);
  }

  palette(name) {
    if (!this.textures.has(name)) this.textures.set(name, paletteTexture(this.description.channels[name].colors, this.description.channels[name].unknown));
    return this.textures.get(name);
  }

  reset() {
    this.through = null;
    this.camera.position.fromArray(this.description.eye);
    this.camera.up.fromArray(this.description.up);
    this.camera.lookAt(new Vector3().fromArray(this.description.target));
    (this.panes || []).forEach((pane) => pane.controls.target.fromArray(this.description.target));
  }

  compose() {
    (this.panes || []).forEach((pane) => pane.compose());
    if (this.panes) this.draw();
  }

  clickCamera(pane, x, y) {
    return this.cameras.click(pane, x, y);
  }

  lookThrough(camera) {
    this.through = camera;
    const target = standIn(this, camera);
    this.camera.lookAt(target);
    this.panes.forEach((pane) => pane.controls.target.copy(target));
    this.draw();
  }

  key(event, pane) {
    if (event.key === "Enter" && this.tools.mode) {
      this.tools.click(pane, 0.5 * pane.canvas.clientWidth, 0.5 * pane.canvas.clientHeight);
      event.preventDefault();
      return;
    }
    if (event.key === "Escape" && this.tools.mode) {
      this.tools.clear();
      return;
    }
    const turns = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] };
    const target = this.panes[0].controls.target;
    const offset = this.camera.position.clone().sub(target);
    if (event.key in turns) {
      const [pitch, yaw] = turns[event.key];
      const right = new Vector3(1, 0, 0).applyQuaternion(this.camera.quaternion);
      const spin = new Quaternion().setFromAxisAngle(right, pitch * TURN);
      spin.premultiply(new Quaternion().setFromAxisAngle(this.camera.up.clone().normalize(), yaw * TURN));
      offset.applyQuaternion(spin);
      this.camera.up.applyQuaternion(spin);
    } else if (event.key === "+" || event.key === "=") offset.multiplyScalar(0.85);
    else if (event.key === "-") offset.multiplyScalar(1 / 0.85);
    else if (event.key.toLowerCase() === "r") {
      this.reset();
      this.draw();
      return;
    } else return;
    event.preventDefault();
    this.camera.position.copy(target).add(offset);
    this.camera.lookAt(target);
    this.draw();
  }

  bind() {
    const at = (name) => this.root.querySelector(`[data-control="${name}"]`);
    for (const [name, channel] of Object.entries(this.description.channels)) {
      at("color").add(new Option(channel.label, name));
    }
    at("color").addEventListener("change", (event) => this.recolor(event.target.value));
    at("two").addEventListener("change", (event) => {
      this.panes[1].element.hidden = !event.target.checked;
      this.draw();
    });
    at("shaded").addEventListener("change", (event) => {
      this.shaded = event.target.checked;
      this.panes.forEach((pane) => pane.paint());
      this.draw();
    });
    at("size").addEventListener("input", (event) => {
      this.pointScale = Number(event.target.value);
      this.draw();
    });
    at("reset").addEventListener("click", () => {
      this.reset();
      this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(this.root);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  recolor(name) {
    this.color = name;
    const channel = this.description.channels[name];
    const legend = this.root.querySelector(".legend");
    legend.replaceChildren();
    if (channel.classes) {
      channel.classes.forEach((label, i) => {
        const item = document.createElement("span");
        item.textContent = label;
        item.style.setProperty("--swatch", channel.colors[Math.floor(((i + 0.5) * channel.colors.length) / channel.classes.length)]);
        item.className = "class";
        legend.append(item);
      });
    } else if (channel.range) {
      const [low, high] = channel.range.map((value) => `${Number(value.toPrecision(3))} ${channel.unit}`.trim());
      const bar = document.createElement("span");
      bar.className = "bar";
      const colors = channel.colors || ["#000000", "#ffffff"];
      const num = Math.min(LEGEND_STOPS, colors.length);
      const stops = Array.from({ length: num }, (_, i) => colors[Math.round((i * (colors.length - 1)) / (num - 1))]);
      bar.style.background = `linear-gradient(90deg, ${stops.join(",")})`;
      legend.append(low, bar, high);
      if (channel.unknown) {
        const none = document.createElement("span");
        none.textContent = "no value";
        none.style.setProperty("--swatch", channel.unknown);
        none.className = "class";
        legend.append(none);
      }
    }
    this.root.querySelector(".note").textContent = channel.note || "";
    this.panes.forEach((pane) => pane.paint());
    this.draw();
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.panes.filter((pane) => !pane.element.hidden).forEach((pane) => pane.draw());
    });
  }

  async start() {
    this.root.querySelector('[data-control="color"]').value = this.color;
    const [first, second] = this.description.start;
    this.panes[1].element.hidden = second === null;
    this.root.querySelector('[data-control="two"]').checked = second !== null;
    await this.panes[0].show(first);
    await this.panes[1].show(second === null ? first : second);
    this.recolor(this.color);
    this.root.dataset.ready = "true";
  }
}

const root = document.getElementById("view3d");
if (root) {
  try {
    new View(root).start();
  } catch (error) {
    const note = document.createElement("p");
    note.className = "warning";
    note.textContent = `The 3D view needs WebGL, which this browser does not give: ${error.message}`;
    root.replaceChildren(note);
  }
}
