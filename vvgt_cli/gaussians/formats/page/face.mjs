// The image of the volume on the faces of a cut: a polygon each, which hides the Gaussians behind it where it is not black.
import { BLEND_NONE, CULLFACE_NONE, GraphNode, Mesh, MeshInstance, PIXELFORMAT_RGBA8, SEMANTIC_POSITION, SEMANTIC_TEXCOORD0, ShaderMaterial, Texture } from 'playcanvas';
import { sectionOf } from './handles.mjs';
import { dot, plus } from './lens.mjs';

const EDGE = 320;  // px of the longer side of an image
const OUT = 0.002;  // in front of the cut's plane, where Gaussians end
const SHADER = {
  uniqueName: 'vvgtFace', attributes: { vertex_position: SEMANTIC_POSITION, vertex_texCoord0: SEMANTIC_TEXCOORD0 },
  vertexGLSL: 'attribute vec3 vertex_position; attribute vec2 vertex_texCoord0; uniform mat4 matrix_viewProjection; varying vec2 at; void main(void) { at = vertex_texCoord0; gl_Position = matrix_viewProjection * vec4(vertex_position, 1.0); }',
  fragmentGLSL: 'varying vec2 at; uniform sampler2D vvgtFaceImage; void main(void) { vec4 color = texture2D(vvgtFaceImage, at); if (color.a < 0.5 || max(color.r, max(color.g, color.b)) < 0.002) discard; gl_FragColor = vec4(color.rgb / color.a, 1.0); }',
};

// what of a polygon is not beyond a plane
const within = (points, { normal, place }) => points.flatMap((p, i) => {
  const q = points[(i + 1) % points.length], [a, b] = [p, q].map((x) => dot(normal, x) - place);
  return [...(a <= 0 ? [p] : []), ...(a * b < 0 ? [plus(p, plus(q, p, -1), a / (a - b))] : [])];
});

// show(planes, corners: of the volume, image(from, across, down, n, m)): all in the viewer's axes; no planes: nothing
export function facesOf({ app }) {
  const layer = app.scene.layers.getLayerByName('World');
  let shown = [];
  return function show(planes, corners, image) {
    layer.removeMeshInstances(shown.map(({ instance }) => instance));
    for (const { instance, texture } of shown) { instance.destroy(); texture.destroy(); }
    shown = planes.flatMap((plane) => {
      const { points: all, side, other } = sectionOf(corners, plane), points = planes.reduce((some, one) => (one === plane ? some : within(some, one)), all);
      if (points.length < 3) return [];
      const spans = [side, other].map((d) => points.map((p) => dot(d, p))), [[x, y], [w, h]] = [spans.map((some) => Math.min(...some)), spans.map((some) => Math.max(...some) - Math.min(...some) || 1e-6)];
      const pixel = Math.max(w, h) / EDGE, [n, m] = [w, h].map((length) => Math.max(Math.ceil(length / pixel), 1)), from = plus(plus(plus([0, 0, 0], plane.normal, plane.place), side, x + w / n / 2), other, y + h / m / 2);
      const texture = new Texture(app.graphicsDevice, { name: 'vvgtFace', width: n, height: m, format: PIXELFORMAT_RGBA8, mipmaps: false, addressU: 1, addressV: 1 });
      texture.lock().set(image(from, plus(from, side, w / n), plus(from, other, h / m), n, m).data);
      texture.unlock();
      const mesh = new Mesh(app.graphicsDevice), material = new ShaderMaterial(SHADER);
      mesh.setPositions(points.flatMap((p) => plus(p, plane.normal, OUT)));
      mesh.setUvs(0, points.flatMap((p) => [(dot(side, p) - x) / w, (dot(other, p) - y) / h]));
      mesh.setIndices(points.slice(2).flatMap((_, k) => [0, k + 1, k + 2]));
      mesh.update();
      Object.assign(material, { cull: CULLFACE_NONE, blendType: BLEND_NONE });
      material.setParameter('vvgtFaceImage', texture);
      material.update();
      return [{ instance: new MeshInstance(mesh, material, new GraphNode()), texture }];
    });
    layer.addMeshInstances(shown.map(({ instance }) => instance));
    app.renderNextFrame = true;
  };
}
