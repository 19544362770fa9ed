// assert_stats.mjs STATS.json FILE.ply: gaussian, and neither NaN nor inf in any column.
import { readFileSync } from "node:fs";
const [path, file] = process.argv.slice(2);
const info = JSON.parse(readFileSync(path, "utf8"));
const data = info.stats[0].data;
const sum = (counts) => counts.reduce((a, b) => a + b, 0);
const nan = sum(data.nanCount), inf = sum(data.infCount);
const good = info.gaussian === true && info.numGaussians > 0 && nan === 0 && inf === 0;
console.log(`${file}: gaussian ${info.gaussian}, ${info.numGaussians} Gaussians, nan ${nan}, inf ${inf}`);
process.exit(good ? 0 : 1);
