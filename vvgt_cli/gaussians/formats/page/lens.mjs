// The camera of the page: where it is, what a pixel sees, perspective or orthographic, and set to a pose at once.
import { PROJECTION_ORTHOGRAPHIC, PROJECTION_PERSPECTIVE, Vec2, Vec3 } from 'playcanvas';

const DEGREES = Math.PI / 180;
const of = (v) => [v.x, v.y, v.z], vec = (a) => new Vec3(...a);
export const plus = (a, b, s = 1) => a.map((x, i) => x + s * b[i]), dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// {rig: what carries the camera, pose, set, toward, orbit, move, project, ray, perPixel, flat, middle}; places are in the viewer's axes, pixels are of CSS
export function lensOf(viewer) {
  const { app } = viewer, canvas = app.graphicsDevice.canvas, entity = app.root.findComponent('camera').entity, { camera } = entity;
  const rig = viewer.cameraManager();
  const focus = new Vec3();
  let flat = false;
  const tangent = () => {  // of half the vertical field of view
    const t = Math.tan((rig.camera.fov * DEGREES) / 2), { clientWidth: w, clientHeight: h } = canvas;
    return w > h ? (t * h) / w : t;
  };
  const target = () => { rig.camera.calcFocusPoint(focus); return of(focus); };
  const basis = () => ({ right: of(entity.right), up: of(entity.up), forward: of(entity.forward) });
  const eye = () => of(entity.getPosition());

  // after the viewer's own: it leaves the projection alone. Parallel rays begin before everything, however near the eye is.
  app.on('update', () => {
    if (app.xr?.active) return;
    camera.projection = flat ? PROJECTION_ORTHOGRAPHIC : PROJECTION_PERSPECTIVE;
    if (!flat) return;
    const back = rig.camera.distance + 2 * camera.farClip;
    camera.orthoHeight = rig.camera.distance * tangent();
    camera.farClip += back;
    entity.translateLocal(0, 0, back);
  });

  const lens = {
    canvas, basis, eye, rig: entity.parent,
    get flat() { return flat; },
    set flat(now) {
      flat = now;
      app.scene.gsplat.radialSorting = !now;
      app.renderNextFrame = true;
    },
    // the pixel at which what the view turns about is seen
    get middle() {
      const { projectionOffset: { x, y } } = camera, { clientWidth: w, clientHeight: h } = canvas;
      return [((1 - x) * w) / 2, ((1 + y) * h) / 2];
    },
    set middle([x, y]) {
      camera.projectionOffset = new Vec2(1 - (2 * x) / Math.max(canvas.clientWidth, 1), (2 * y) / Math.max(canvas.clientHeight, 1) - 1);
      app.renderNextFrame = true;
    },
    pose: () => ({ target: target(), pitch: rig.camera.angles.x, yaw: rig.camera.angles.y, distance: rig.camera.distance }),
    set({ target: at, pitch, yaw, distance }) {
      viewer.state.cameraMode = 'orbit';
      const { camera: now } = rig;
      now.angles.set(pitch, yaw, 0);
      now.distance = distance;
      now.position.set(0, 0, 0);
      now.calcFocusPoint(focus);
      now.position.copy(vec(at)).sub(focus);
      rig.snap();
    },
    // the angles of a view from a direction; up is shown upwards where the direction is vertical
    toward(from, up) {
      const level = Math.hypot(from[0], from[2]) > 1e-3, [x, z] = level ? [from[0], from[2]] : from[1] > 0 ? [-up[0], -up[2]] : [up[0], up[2]];
      return { pitch: -Math.asin(Math.max(-1, Math.min(1, from[1]))) / DEGREES, yaw: Math.atan2(x, z) / DEGREES };
    },
    // about the target, to the right and up, in degrees, and so many times as far
    orbit(right, up, times = 1) {
      const { pitch, yaw, distance, ...rest } = lens.pose();
      lens.set({ ...rest, pitch: Math.max(-90, Math.min(90, pitch - up)), yaw: yaw + right, distance: distance * times });
    },
    // the target, to the right and up, by pixels
    move(x, y) {
      const { right, up } = basis(), { target: at, ...rest } = lens.pose(), by = lens.perPixel();
      lens.set({ ...rest, target: plus(plus(at, right, x * by), up, y * by) });
    },
    // [x, y] in pixels of a place, null behind the eye
    project(p) {
      const { right, up, forward } = basis(), d = plus(p, eye(), -1), depth = dot(d, forward), [x, y] = lens.middle, h = canvas.clientHeight;
      if (!flat && depth <= 0) return null;
      const half = flat ? camera.orthoHeight : depth * tangent();
      return [x + (dot(d, right) / half) * (h / 2), y - (dot(d, up) / half) * (h / 2)];
    },
    ray(x, y) {
      const { right, up, forward } = basis(), [left, top] = lens.middle, h = canvas.clientHeight, half = flat ? camera.orthoHeight : tangent();
      const [a, b] = [(2 * (x - left)) / h, (2 * (top - y)) / h], aside = plus(plus([0, 0, 0], right, a * half), up, b * half);
      return flat ? { origin: plus(eye(), aside), direction: forward } : { origin: eye(), direction: plus(forward, aside) };
    },
    // how long a pixel is where the view turns about
    perPixel: () => (2 * rig.camera.distance * tangent()) / canvas.clientHeight,
  };
  return lens;
}
