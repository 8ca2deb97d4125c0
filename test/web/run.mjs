// Tests of the live page against a simulated site with a gromad; GROMA names the program groma. GROMA_PAGE, for work on the
// page, names a folder with another build of it, which the browser shows in place of gromad's.
//   node run.mjs                    in Chromium, and all below
//   node run.mjs --without-browser  the page's model and Foxglove's client, in Node alone
import { check_foxglove, check_layout } from "./foxglove.mjs";
import { check_model } from "./model.mjs";
import { PoseStream, start_site } from "./site.mjs";

const kMostFailures = 8; // then the rest says nothing new
let passed = 0;
const failed = [];

// One test: prints its name, and why it failed. Others still run.
async function check(name, test) {
  const begin = performance.now();
  try {
    await test();
    passed++;
    console.log(`ok      ${name} (${((performance.now() - begin) / 1000).toFixed(1)} s)`);
  } catch (error) {
    failed.push(name);
    console.log(`FAILED  ${name}\n${String(error?.stack ?? error).replace(/^/gm, "        ")}`);
    if (failed.length >= kMostFailures) throw new Error("too many failures");
  }
}

async function without_browser() {
  await check_layout(check);
  const site = await start_site();
  const stream = new PoseStream(site.stream_port);
  try {
    await Promise.all([check_model(site, stream, check, 2), check_foxglove(site, stream, check)]);
  } finally {
    stream.close();
    await site.stop();
  }
  await check("groma ends the site when asked to", () => {
    if (site.exit_code !== 0) throw new Error(`exit code ${site.exit_code}:\n${site.log}`);
  });
}

try {
  await without_browser();
  if (!process.argv.includes("--without-browser")) {
    const { check_page } = await import("./browser.mjs");
    await check_page(check);
  }
} catch (error) {
  failed.push("the run");
  console.log(`FAILED  the run ended early\n${error?.stack ?? error}`);
}
console.log(`${passed} passed, ${failed.length} failed${failed.map((name) => `\n  ${name}`).join("")}`);
process.exit(failed.length === 0 ? 0 : 1);
