// MIP and X-ray of live Gaussians (vvgt_cli/splat/grey.py has the formulas): the engine's shaders that draw them, without an order.
import { BLEND_MAX, BLEND_PREMULTIPLIED } from 'playcanvas';

export const KINDS = ['colours', 'MIP', 'X-ray'];
const SCREEN = `
	vvgtGrey = vec4(0.0);
	if (vvgtKind > 0.5) {
		float opacity = getOpacity();
		vec3 code = getColor();
		bool flatly = camera_params.w == 1.0;
		if (vvgtKind > 1.5) {
			float area = 6.2831853 * sqrt(lambda1 * lambda2) * vp.z * vp.z / abs(focal.x * focal.y);
			vvgtGrey.x = exp2(12.0 * code.r - 48.0) / area * (flatly ? 1.0 : length(v) / abs(v.z)) / (1.0 - exp(-4.0));
		} else {
			vec3 own = (code - 2.0) * 0.125;
			vec2 joint = (transpose(T) * (quatToMat3(getRotation()) * (getScale() * own))).xy * (flatly ? 1.0 : -1.0);
			vec2 along = vec2(dot(joint, diagonalVector), dot(joint, vec2(diagonalVector.y, -diagonalVector.x)));
			vvgtGrey.yz = along * vec2(l1, l2) / vec2(lambda1, lambda2);
			vvgtGrey.x = opacity + 0.75 * sqrt(max(dot(own, own) - dot(along * along, 1.0 / vec2(lambda1, lambda2)), 0.0));
		}
	}
	corner.uv = source.cornerUV;
	return true;
`;
// what the engine's shaders have, and what they get; before those that the page's drawing rule needs
const CHANGES = [
  ['gsplatCornerVS', 'uniform float minPixelSize;', 'uniform float minPixelSize;\nuniform float vvgtKind;\nvec4 vvgtGrey;'],
  ['gsplatCornerVS', '	corner.offset = vec3((source.cornerUV.x * v1 + source.cornerUV.y * v2) * c, 0.0);\n	corner.uv = source.cornerUV;\n	return true;\n', `	corner.offset = vec3((source.cornerUV.x * v1 + source.cornerUV.y * v2) * c, 0.0);${SCREEN}`],
  ['gsplatCornerVS', 'max(l1, l2) < minPixelSize', 'vvgtKind < 0.5 && max(l1, l2) < minPixelSize'],
  ['gsplatVS', 'clr.w <= alphaClipValue', 'clr.w <= (vvgtKind < 0.5 ? alphaClipValue : 0.0)'],
  ['gsplatVS', 'clipCorner(corner, clr.w);', 'if (vvgtKind < 0.5) clipCorner(corner, clr.w);'],
  ['gsplatVS', 'gaussianColor = vec4(prepareOutputFromGamma(', 'gaussianColor = vvgtKind > 0.5 ? vvgtGrey : vec4(prepareOutputFromGamma('],
  ['gsplatPS', 'void main(void) {', `uniform float vvgtKind;
float vvgtAlpha(float p) {
	if (vvgtKind > 1.5) return 1.0 - exp(-gaussianColor.x * exp(-p));
	float t = clamp((3.0 - p) / 2.5, 0.0, 1.0);
	return clamp(gaussianColor.x + dot(gaussianColor.yz, gaussianUV), 0.0, 1.0) * t * t * (3.0 - 2.0 * t);
}
void main(void) {`],
  ['gsplatPS', 'normExp(A) * gaussianColor.a', '(vvgtKind < 0.5 ? normExp(A) * gaussianColor.a : vvgtAlpha(4.0 * A))'],
  ['gsplatPS', 'if (alpha < alphaClipForward)', 'if (vvgtKind < 0.5 && alpha < alphaClipForward)'],
  ['gsplatPS', 'vec4(gaussianColor.xyz, alpha)', 'vec4(vvgtKind < 0.5 ? gaussianColor.xyz : vec3(1.0), alpha)'],
];

// makes the engine's shaders able to; change(name of a shader, what it has, what it gets)
export function teach(app, change) {
  CHANGES.forEach((one) => change(...one));
  app.scene.gsplat.material.setParameter('vvgtKind', 0);
}

// how splats are drawn from now on
export function drawn({ scene: { gsplat: { material } }, renderer: { gsplatDirector } }, kind) {
  material.setParameter('vvgtKind', kind);
  material.update();
  const all = [...gsplatDirector.camerasMap.values()].flatMap(({ layersMap }) => [...layersMap.values()]);
  for (const { gsplatManager } of all) if (gsplatManager) gsplatManager.material.blendType = kind === 1 ? BLEND_MAX : BLEND_PREMULTIPLIED;
}
