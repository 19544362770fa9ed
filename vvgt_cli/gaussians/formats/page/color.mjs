// Colours as elements have them, "#rrggbb", and as RGB in [0, 1].
export const hex = (rgb) => `#${rgb.map((c) => Math.round(255 * Math.min(Math.max(c, 0), 1)).toString(16).padStart(2, '0')).join('')}`;
export const rgbOf = (text) => [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16) / 255);
