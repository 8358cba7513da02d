// A chosen camera: its pictures beside the 3D view, and the view through it.
import { BufferAttribute, BufferGeometry, LineBasicMaterial, LineSegments, Vector3 } from "three";
import { pickCamera } from "./picking.js";

const COLOR = 0x0072b2;
const CHOSEN = 0xd55e00;
const SHOWN = ["intensity", "AoLP", "reprojected mesh"]; // of the view's pictures, by their kind

function frusta(cameras, color) {
  const ends = cameras.flatMap(({ center, corners }) =>
    corners.flatMap((corner, i) => [center, corner, corner, corners[(i + 1) % 4]]).flat(),
  );
  const lines = new LineSegments(
    new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(ends), 3)),
    new LineBasicMaterial({ color }),
  );
  lines.frustumCulled = false;
  return lines;
}

export class Cameras {
  constructor(view) {
    this.view = view;
    this.visible = false;
    this.chosen = null;
    const all = view.description.cameras;
    this.lines = frusta(all, COLOR);
    this.panel = view.root.querySelector("[data-panel=camera]");
    this.box = view.root.querySelector("[data-control=frusta]");
    this.list = view.root.querySelector("[data-control=camera]");
    all.forEach((camera, i) => this.list.add(new Option(camera.name, String(i))));
    this.list.closest("label").hidden = !all.length;
    this.list.addEventListener("change", () => this.choose(this.list.value === "" ? null : all[Number(this.list.value)]));
    this.box.addEventListener("change", () => {
      this.visible = this.box.checked;
      view.compose();
    });
    this.panel.querySelector("[data-control=through]").addEventListener("click", () => view.lookThrough(this.chosen));
    this.panel.querySelector("[data-control=close]").addEventListener("click", () => {
      this.choose(null);
      this.list.focus();
    });
  }

  drawn() {
    if (!this.visible) return [];
    return this.chosen ? [this.lines.clone(), frusta([this.chosen], CHOSEN)] : [this.lines.clone()];
  }

  // The camera under the pointer, where they are drawn; whether there is one.
  click(pane, x, y) {
    const found = this.visible ? pickCamera(pane, x, y) : null;
    if (found) this.choose(found);
    return Boolean(found);
  }

  choose(camera) {
    this.chosen = camera;
    this.list.value = camera ? String(this.view.description.cameras.indexOf(camera)) : "";
    this.panel.hidden = !camera;
    if (camera) {
      this.visible = this.box.checked = true;
      this.panel.querySelector("h3").textContent = `Camera ${camera.name}`;
      this.panel.querySelector(".shots").replaceChildren(...this.pictures(camera));
    }
    this.view.compose();
  }

  // Its pictures among those of the page; each opens large as there.
  pictures(camera) {
    const page = document.querySelectorAll("#views > details")[camera.index];
    return SHOWN.flatMap((kind) => {
      const figure = page && page.querySelector(`figure[data-kind="${kind}"]`);
      if (!figure) return [];
      const copy = figure.cloneNode(true);
      copy.querySelector(".thumb").addEventListener("click", () => figure.querySelector(".thumb").click());
      return [copy];
    });
  }
}

// Where a camera stands and what it looks along.
export function standIn(view, camera) {
  const { center, corners, forward } = camera;
  const eye = new Vector3().fromArray(center);
  const far = eye.distanceTo(new Vector3().fromArray(view.description.target));
  view.camera.position.copy(eye);
  view.camera.up.fromArray(corners[0]).sub(new Vector3().fromArray(corners[3])).normalize();
  return eye.clone().addScaledVector(new Vector3().fromArray(forward), far);
}
