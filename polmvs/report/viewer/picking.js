// What lies under the pointer: a point of the shown cloud or mesh, or a camera.
import { Matrix4, Raycaster, Vector2, Vector3 } from "three";

const REACH_PX = 7; // from the pointer to a point of a cloud
const FULL = 65535; // of a place, as the page holds it

// Calls visit(index, x, y, depth) for each vertex in front of the camera, in CSS px of the canvas.
export function forEachProjected(pane, visit) {
  const { object, canvas } = pane;
  const camera = pane.view.camera;
  camera.updateMatrixWorld();
  object.updateMatrixWorld();
  const e = new Matrix4()
    .multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse)
    .multiply(object.matrixWorld).elements;
  const places = object.geometry.getAttribute("position").array;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  for (let i = 0; i < places.length; i += 3) {
    const [x, y, z] = [places[i] / FULL, places[i + 1] / FULL, places[i + 2] / FULL];
    const w = e[3] * x + e[7] * y + e[11] * z + e[15];
    if (w <= 0) continue;
    const right = (e[0] * x + e[4] * y + e[8] * z + e[12]) / w;
    const up = (e[1] * x + e[5] * y + e[9] * z + e[13]) / w;
    visit(i / 3, 0.5 * (1 + right) * width, 0.5 * (1 - up) * height, w);
  }
}

export function worldPoint(pane, index) {
  const places = pane.object.geometry.getAttribute("position");
  return new Vector3().fromBufferAttribute(places, index).applyMatrix4(pane.object.matrixWorld);
}

// The surface under the pointer, in the world; null beside it.
export function pickPoint(pane, x, y) {
  if (!pane.object) return null;
  if (pane.built.layer.triangles) {
    const caster = new Raycaster();
    const at = new Vector2((2 * x) / pane.canvas.clientWidth - 1, 1 - (2 * y) / pane.canvas.clientHeight);
    pane.view.camera.updateMatrixWorld();
    caster.setFromCamera(at, pane.view.camera);
    const hit = caster.intersectObject(pane.object)[0];
    return hit ? hit.point : null;
  }
  let best = -1;
  let nearest = Infinity;
  forEachProjected(pane, (index, px, py, depth) => {
    if (depth < nearest && (px - x) ** 2 + (py - y) ** 2 <= REACH_PX ** 2) [best, nearest] = [index, depth];
  });
  return best < 0 ? null : worldPoint(pane, best);
}

// The camera whose drawn image or centre is under the pointer, the nearest one; null beside them.
export function pickCamera(pane, x, y) {
  const { camera, description } = pane.view;
  const [width, height] = [pane.canvas.clientWidth, pane.canvas.clientHeight];
  camera.updateMatrixWorld();
  const project = (point) => {
    const seen = new Vector3().fromArray(point).applyMatrix4(camera.matrixWorldInverse);
    const depth = -seen.z;
    seen.applyMatrix4(camera.projectionMatrix);
    return { x: 0.5 * (1 + seen.x) * width, y: 0.5 * (1 - seen.y) * height, depth };
  };
  let found = null;
  let nearest = Infinity;
  for (const one of description.cameras) {
    const ends = one.corners.map(project);
    const center = project(one.center);
    if (center.depth <= 0 || ends.some((end) => end.depth <= 0)) continue;
    const near = Math.hypot(center.x - x, center.y - y) <= 2 * REACH_PX;
    if ((near || within(ends, x, y)) && center.depth < nearest) [found, nearest] = [one, center.depth];
  }
  return found;
}

function within(ends, x, y) {
  let inside = false;
  ends.forEach((one, i) => {
    const other = ends[(i + 1) % ends.length];
    const crosses = one.y > y !== other.y > y;
    if (crosses && x < ((other.x - one.x) * (y - one.y)) / (other.y - one.y) + one.x) inside = !inside;
  });
  return inside;
}
