// A Gaussian under the function: moved and thinned along the gradient, of the opacity of its mass (docs/live.md), and cut by planes. The engine calls
// modifySplatCenter first. A cut Gaussian becomes one of the mass and mean of its part that stays, no wider than that and up to the plane.
uniform highp sampler2D vvgtTable;
uniform highp sampler2D vvgtLabels;  // a column a row of looks: of a label red, green, blue, extinction; of a function its number in the table, and -1
uniform vec4 vvgtFacts;  // shortest log length, how far it goes, thinnest, spreads
uniform vec4 vvgtOpaque;  // of the variance of what is opaque across its surface; variance of the screen's dilation; mean abs(z) of what is seen, from which on it counts less, and from which on not at all
uniform vec4 vvgtCut[6];  // dot(xyz, centre) <= w of each stays; of none the normal is zero
uniform vec4 vvgtLight;  // ambient, diffuse, specular, power; ambient < 0: unlit
uniform vec4 vvgtToward;  // direction towards the light; with w = 1 it is at the eye
uniform vec4 vvgtEye;  // its place, or with w = 1 the direction of parallel rays
uniform float vvgtKind;  // 0 the look, 1 MIP, 2 X-ray: see grey.mjs
uniform vec2 vvgtSpread;  // widest spread of the table as a share of the range of values, and the bend of its columns
vec4 vvgtColor, vvgtRotation, vvgtFace;  // vvgtFace: of what lies at a cut its direction, and how much of the light is that of the face
vec3 vvgtScale;

vec4 vvgtQuaternion(mat3 m) {  // (x, y, z, w), w >= 0
  vec4 d = vec4(m[0][0] - m[1][1] - m[2][2], m[1][1] - m[0][0] - m[2][2], m[2][2] - m[0][0] - m[1][1], m[0][0] + m[1][1] + m[2][2]) + 1.0;
  vec3 s = vec3(m[1][2] - m[2][1], m[2][0] - m[0][2], m[0][1] - m[1][0]), p = vec3(m[1][2] + m[2][1], m[2][0] + m[0][2], m[0][1] + m[1][0]);
  vec4 q = d.w >= max(d.x, max(d.y, d.z)) ? vec4(s, d.w) : d.x >= max(d.y, d.z) ? vec4(d.x, p.z, p.y, s.x)
    : d.y >= d.z ? vec4(p.z, d.y, p.x, s.y) : vec4(p.y, p.x, d.z, s.z);
  return normalize(q.w < 0.0 ? -q : q);
}

void vvgtTurn(inout vec3 a, inout vec3 b) {  // until orthogonal: one-sided Jacobi
  float c = dot(a, b), aa = dot(a, a), bb = dot(b, b);
  if (abs(c) < 1e-7 * sqrt(aa * bb)) return;
  float zeta = (bb - aa) / (2.0 * c), t = (zeta < 0.0 ? -1.0 : 1.0) / (abs(zeta) + sqrt(1.0 + zeta * zeta));
  float cs = inversesqrt(1.0 + t * t), sn = cs * t;
  vec3 was = a;
  a = cs * was - sn * b;
  b = sn * was + cs * b;
}

float vvgtAlpha(float y) {  // whose dilogarithm is y, to 3e-4
  y = min(y, 1.5886);
  return min(y * (1.0006751 + y * (-0.2572020 + y * (0.0395146 + y * (-0.0420802 + y * (0.0288972 - y * 0.0082833))))), 0.99);
}

float vvgtPeak(float mass, vec3 variance) {  // the mean over views along the axes, by the areas that these see to the power of FACE_ON
  vec3 v = variance + vvgtOpaque.y, area = 6.2831853 * sqrt(v.yzx * v.zxy), y = mass / area, weight = area * sqrt(area);
  y += min(y, vec3(1.0 / 255.0));
  return dot(vec3(vvgtAlpha(y.x), vvgtAlpha(y.y), vvgtAlpha(y.z)), weight) / (weight.x + weight.y + weight.z);
}

float vvgtCutBy(vec4 plane, inout vec3 center, inout mat3 axes) {  // mass's factor
  vec3 own = plane.xyz * axes;
  float sigma = length(own);
  if (sigma < 1e-12) return 1.0;
  float at = (plane.w - dot(plane.xyz, center)) / sigma;
  if (at > 3.0) return 1.0;
  if (at < -2.0) return 0.0;
  float near = clamp(0.5 * (3.0 - at), 0.0, 1.0);
  if (near > vvgtFace.w) vvgtFace = vec4(plane.xyz, near);
  own /= sigma;
  float x = abs(at) * 0.70710678, t = 1.0 / (1.0 + 0.3275911 * x);  // Abramowitz and Stegun 7.1.26
  float tail = 0.5 * t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429)))) * exp(-x * x);
  float stays = at < 0.0 ? tail : 1.0 - tail, mean = 0.39894228 * exp(-0.5 * at * at) / stays;
  float thin = clamp(sqrt(max(1.0 - at * mean - mean * mean, 0.0)), 0.1, max(0.5 * (at + mean), 0.1));  // two deviations reach the plane
  vec3 arm = axes * own;
  center -= arm * mean;
  axes += outerProduct(arm * (thin - 1.0), own);
  return stays;
}

float vvgtCutAll(inout vec3 center, inout mat3 axes) {
  float stays = 1.0;
  vvgtFace = vec4(0.0);
  for (int i = 0; i < 6 && stays > 0.0; i++) stays *= vvgtCutBy(vvgtCut[i], center, axes);
  return stays;
}

vec3 vvgtShaded(vec3 color, vec3 n, float share, vec3 center) {  // Blinn and Phong's (docs/light.md): a share has the normal n, the rest any
  vec3 d = vvgtEye.w > 0.0 ? vvgtEye.xyz : normalize(center - vvgtEye.xyz), l = vvgtToward.w > 0.0 ? -d : vvgtToward.xyz, h = l - d;
  float facing = min(abs(dot(n, h)) / max(length(h), 1e-9), 1.0);
  vec2 seen = mix(vec2(0.5, 1.0 / (vvgtLight.w + 1.0)), vec2(abs(dot(n, l)), pow(facing, vvgtLight.w)), share);
  return min(color * (vvgtLight.x + vvgtLight.y * seen.x) + vvgtLight.z * seen.y, vec3(1.0));
}

vec3 vvgtLit(vec3 color, vec3 axis, vec3 center) {
  if (vvgtLight.x < 0.0) return color;
  float share = length(axis);
  vec3 own = share == 0.0 ? color * vvgtLight.x : vvgtShaded(color, axis / share, min(share, 1.0), center);
  return vvgtFace.w > 0.0 ? mix(own, vvgtShaded(color, vvgtFace.xyz, 1.0, center), vvgtFace.w) : own;
}

void modifySplatCenter(inout vec3 center) {
  uvec4 a = loadVvgtValues(), b = loadVvgtGradient();
  int spreads = int(vvgtFacts.w), at = int(a.x);
  float column = float(a.y) * (vvgtFacts.w - 1.0) / 255.0;
  int j = min(int(column), spreads - 2);
  float f = column - float(j);
  vec4 look = texelFetch(vvgtLabels, ivec2(int(a.w) + 256 * int(b.w), 0), 0), sums = vec4(look.rgb * look.a, look.a);
  vec2 z = vec2(0.0, look.a);
  if (look.a < 0.0) {
    int near = 2 * spreads * int(look.r) + j;
    sums = mix(texelFetch(vvgtTable, ivec2(at, near), 0), texelFetch(vvgtTable, ivec2(at, near + 1), 0), f);
    z = mix(texelFetch(vvgtTable, ivec2(at, near + spreads), 0).xy, texelFetch(vvgtTable, ivec2(at, near + 1 + spreads), 0).xy, f);
  }
  bool mip = vvgtKind == 1.0;
  if (mip) {  // as it is, under any function
    sums = vec4(1.0);
    z = vec2(0.0, 1.0);
  }
  float whole = max(sums.a, 1e-12), first = z.x / whole, variance = max(z.y / whole - first * first, 0.0);
  float tau = whole * clamp((vvgtOpaque.w - abs(first)) / (vvgtOpaque.w - vvgtOpaque.z), 0.0, 1.0);
  mat3 turn = quatToMat3(getRotation());
  vec3 scale = getScale(), gradient = (vec3(b.xyz) - 128.0) / 127.0, along = gradient * turn * scale;
  along /= max(length(along), 1e-30);
  float edge = exp(vvgtFacts.x + vvgtFacts.y * float(a.z) / 255.0), fog = mip ? 1.0 : exp(-tau * edge), r = min(length(gradient), 1.0), facing = r * r;
  float thin = sqrt(max(1.0 - facing * (1.0 - variance), vvgtFacts.z * vvgtFacts.z) * (1.0 - (1.0 - fog) * facing * (1.0 - vvgtOpaque.x)));
  mat3 axes = mat3(matrix_model) * mat3(turn[0] * scale.x, turn[1] * scale.y, turn[2] * scale.z);
  vec3 arm = axes * along;
  center += arm * (r * first);
  axes += outerProduct(arm * (thin - 1.0), along);
  vec3 normals = mat3(matrix_model) * ((vec3(loadVvgtAxis().xyz) - 128.0) / 127.0), across = normals * axes;
  across /= max(length(across), 1e-30);
  axes += outerProduct(axes * across * (sqrt(1.0 - (1.0 - fog) * (1.0 - facing) * (1.0 - vvgtOpaque.x)) - 1.0), across);
  vec3 place = center, joint = axes * along;
  float stays = vvgtCutAll(center, axes), mass = tau * edge * edge * edge * stays;
  vec3 color = vvgtLit(sums.rgb / whole, normals, place);
  for (int sweep = 0; sweep < 6; sweep++) {
    vvgtTurn(axes[0], axes[1]);
    vvgtTurn(axes[0], axes[2]);
    vvgtTurn(axes[1], axes[2]);
  }
  vvgtScale = vec3(length(axes[0]), length(axes[1]), length(axes[2]));
  mat3 unit = mat3(axes[0] / vvgtScale.x, axes[1] / vvgtScale.y, axes[2] / vvgtScale.z);
  if (determinant(unit) < 0.0) unit[2] = -unit[2];
  vvgtRotation = vvgtQuaternion(unit);
  if (mip) {  // the value, and how it changes along the Gaussian's own axes
    float spread = r * vvgtSpread.x * pow(float(a.y) / 255.0, vvgtSpread.y);
    vvgtColor = vec4(2.0 + 8.0 * spread * (joint * unit) / vvgtScale, stays > 0.0 ? float(at) / 255.0 : 0.0);
    return;
  }
  if (vvgtKind == 2.0) {  // the logarithm of its mass
    vvgtColor = vec4(log2(max(whole * edge * edge * edge * stays, 1e-15)) / 12.0 + 4.0, 0.0, 0.0, stays > 0.0 ? 1.0 : 0.0);
    return;
  }
  vvgtColor = sums.a < 1e-12 ? vec4(0.0) : vec4(color, vvgtPeak(mass, vvgtScale * vvgtScale));
}
void modifySplatRotationScale(vec3 original, vec3 modified, inout vec4 rotation, inout vec3 scale) {
  rotation = vvgtRotation;
  scale = vvgtScale;
}
void modifySplatColor(vec3 center, inout vec4 color) { color = vvgtColor; }
