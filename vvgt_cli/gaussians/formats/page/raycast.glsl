#version 300 es
// A ray through the layers of a volume (raycast.mjs writes their functions): segments between samples, of which a function's mean over the values
// between both is taken (pre-integration), else the mean of both ends; light as vvgt_cli/dvr/shading.py has it. Added to what was drawn before.
precision highp float;
precision highp int;
precision highp sampler3D;
precision highp usampler3D;
uniform vec3 origin[3], direction[3], jitter;  // at the lower left corner, and what they gain across and up; of the pixel, and of the first sample
uniform vec4 cuts[6], light, toward, face;  // dot(xyz, place) <= w of each stays; ambient (< 0: unlit), diffuse, specular, power; with w = 1 the light is at the eye; w > 0: the values from x on, as 1 / y greys, are shown on the cut
uniform vec2 size, grey;  // of the picture; what is black of a MIP or X-ray, and 1 / window
uniform float ds, again, most;  // between samples; frames before; by how much extinction may differ between two
uniform int kind, faced, alone;  // 0 the look, 1 MIP, 2 X-ray; the layer on the cut; whether a piece is all that shows
uniform sampler3D piece;
uniform sampler2D looks, before;
out vec4 color;
const float LAST = float(TABLE - 1), MANY = 64.0, OPAQUE = 0.9995, THIN = 0.01;
const int ROWS = TABLE >> 8, PARTS = 8;

vec4 entry(float i, int first) { return texelFetch(looks, ivec2(int(i) & 255, first + (int(i) >> 8)), 0); }
vec4 upTo(float s, int first) {
  float x = s * LAST, i = min(floor(x), LAST - 1.0);
  return mix(entry(i, first), entry(i + 1.0, first), x - i);
}
vec4 between(float a, float b, int first) {  // the mean of extinction times red, green, blue and 1; sums over many entries, as single precision needs
  a = clamp(a, 0.0, 1.0);
  b = clamp(b, 0.0, 1.0);
  if (abs(b - a) * LAST > MANY) return (upTo(b, first + ROWS) - upTo(a, first + ROWS)) / (b - a);
  vec4 x = floor(mix(vec4(a), vec4(b), vec4(0.125, 0.375, 0.625, 0.875)) * LAST + 0.5);
  return 0.25 * (entry(x.x, first) + entry(x.y, first) + entry(x.z, first) + entry(x.w, first));
}
bool within(vec3 q) { return all(greaterThanEqual(q, vec3(-1e-4))) && all(lessThanEqual(q, vec3(1.0001))); }
float leaving(ivec3 block, vec3 q, vec3 r) {  // how far to the end of a block
  vec3 e = (vec3(block) + step(vec3(0.0), r) - q) / mix(r, vec3(1e-9), lessThan(abs(r), vec3(1e-9)));
  return max(min(e.x, min(e.y, e.z)), 0.0) + 1e-5;
}
vec3 lit(vec3 c, vec3 n, vec3 d) {
  if (light.x < 0.0) return c;
  float length_ = length(n);
  if (!(length_ > 0.0) || isinf(length_)) return min(c * light.x, vec3(1.0));
  n /= length_;
  vec3 l = toward.w > 0.0 ? -d : toward.xyz, h = l - d;
  float half_ = length(h), white = half_ > 1e-9 ? pow(min(abs(dot(n, h)) / half_, 1.0), light.w) : 0.0;
  return min(c * (light.x + light.y * abs(dot(n, l))) + light.z * white, vec3(1.0));
}

LAYERS

// red, green, blue and opacity of a segment, and how far along the ray, on average, it absorbs
vec4 passed(Sample a, Sample b, vec3 o, vec3 d, float from, float to, out float place) {
  vec4 one = optics(a, b);
  float depth = one.a * (to - from), part = (to - from) / float(PARTS), rest = 1.0;
  place = 0.5 * (from + to);
  if (depth <= 0.0) return vec4(0.0);
  bool fine = depth > THIN && steep(a, b);
  if (!fine && depth <= 1.0) return vec4(one.rgb / one.a, 1.0) * (1.0 - exp(-depth));
  Sample first = a;
  vec4 own = vec4(0.0);
  float sum = 0.0;
  for (int n = 1; n <= PARTS; n++) {
    Sample next = blended(first, b, float(n) / float(PARTS));
    if (fine && n < PARTS) next = sampled(o + d * (from + float(n) * part));
    one = optics(a, next);
    float alpha = rest * (1.0 - exp(-one.a * part));
    if (alpha > 0.0) {
      own += alpha * vec4(one.rgb / one.a, 1.0);
      sum += alpha * (float(n) - 0.5);
      rest -= alpha;
    }
    a = next;
  }
  if (fine && own.a > 0.0) place = from + part * sum / own.a;
  return own;
}

vec4 along(vec3 o, vec3 d, float t0, float t1, vec3 cut) {
  float start = fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715))) + jitter.z), last = t0, t = t0 + ds * start, A = 0.0, best = -1.0, end = t0;
  vec3 C = vec3(0.0);
  Sample then = sampled(o + d * t0);
  if (face.w > 0.0 && dot(cut, cut) > 0.0) {
    vec4 seen = onFace(o + d * t0);
    if (max(seen.r, max(seen.g, seen.b)) >= 0.002) return vec4(seen.rgb, 1.0);
  }
  for (int i = 0; i < 8192 && last < t1 && A < OPAQUE; i++) {
    if (last >= end) {
      vec2 block = empty(o + d * (last + 1e-5), d, best);
      if (block.y == 0.0) {
        last += block.x;
        t = t0 + ds * (start + ceil((last - t0) / ds - start));
        if (t <= last) t += ds;
        then = sampled(o + d * last);
        continue;
      }
      end = last + block.x;
    }
    t = min(t, t1);
    Sample now = sampled(o + d * t);
    if (kind == 1) {
      if (alone == 0 || kept(o + d * t) > 0.5) best = max(best, greater(then, now));
    }
    else {
      float place;
      vec4 own = passed(then, now, o, d, last, t, place);
      if (alone > 0 && own.a > 0.0) own *= kept(o + d * place);
      if (own.a > 0.0) {
        vec3 c = own.rgb / own.a;
        if (kind == 0 && light.x >= 0.0) c = dot(cut, cut) > 0.0 && last - t0 < ds ? lit(c, cut, d) : lighted(c, then, now, o + d * place, d);
        C += (1.0 - A) * own.a * c;
        A += (1.0 - A) * own.a;
      }
    }
    last = t;
    t += ds;
    then = now;
  }
  return kind == 0 ? vec4(C, A) : vec4(vec3(clamp(((kind == 2 ? A : best) - grey.x) * grey.y, 0.0, 1.0)), 1.0);
}

void main() {
  vec2 u = (gl_FragCoord.xy - 0.5 + jitter.xy) / size;
  vec3 o = origin[0] + u.x * origin[1] + u.y * origin[2], d = normalize(direction[0] + u.x * direction[1] + u.y * direction[2]), cut = vec3(0.0);
  vec3 q = (m0 * vec4(o, 1.0)).xyz, r = mat3(m0) * d, a = -q / r, b = (1.0 - q) / r, near = min(a, b), far = max(a, b);
  float t0 = max(max(near.x, near.y), max(near.z, 0.0)), t1 = min(far.x, min(far.y, far.z));
  for (int i = 0; i < 6; i++) {
    float off = dot(cuts[i].xyz, o) - cuts[i].w, along_ = dot(cuts[i].xyz, d), at = -off / along_;
    if (along_ > 0.0) t1 = min(t1, at);
    else if (along_ < 0.0 && at > t0) { t0 = at; cut = cuts[i].xyz; }
    else if (along_ == 0.0 && off > 0.0) t1 = -1.0;
  }
  color = t0 < t1 ? along(o, d, t0, t1, cut) : vec4(0.0);
  if (again > 0.0) color += texelFetch(before, ivec2(gl_FragCoord.xy), 0);
}
