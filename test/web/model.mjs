// Without a browser: the page's own model reads /live, bundled as its unit tests are.
import assert from "node:assert/strict";
import { mkdtempSync, rmSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import WebSocket from "ws";
import { compare_anchors, compare_calibration, compare_poses, compare_statuses, snapshot } from "./compare.mjs";
import { kRoot, sleep, wait_for } from "./site.mjs";

const kPage = join(kRoot, "host/web/page");

async function page_modules() {
  const { build } = createRequire(join(kPage, "package.json"))("esbuild");
  const folder = mkdtempSync(join(tmpdir(), "groma-web-"));
  try {
    const output = join(folder, "page.mjs");
    const contents = `export { Model, anchors_of } from "./model"; export { state_of, state_words, notices_of } from "./states";`;
    await build({ stdin: { contents, resolveDir: join(kPage, "src"), loader: "ts" }, outfile: output, bundle: true, platform: "node", format: "esm", target: "node18", logLevel: "warning" });
    return await import(pathToFileURL(output).href);
  } finally {
    rmSync(folder, { recursive: true });
  }
}

export async function check_model(site, stream, check, seconds) {
  const { Model, anchors_of, state_of, state_words } = await page_modules();
  await wait_for("a pose", () => stream.last, 30); // so that there is a history
  const model = new Model();
  const socket = new WebSocket(`ws://127.0.0.1:${site.port}/live`);
  const closed = new Promise((resolve) => socket.on("close", resolve));
  socket.on("message", (text) => model.take(JSON.parse(text), performance.now() / 1000));
  await check("the page's model takes the history", () => wait_for("the end of the history", () => model.history === "complete" && model.history_taken > 0, 5));
  await sleep(seconds);
  await check("poses, states and reasons are those of the pose stream", async () => {
    const page = snapshot(model);
    await sleep(0.3);
    assert.ok(compare_poses(page, stream) > 4 * seconds, "too few poses");
  });
  await check("statuses, links and diagnosis are those of the pose stream", () => assert.ok(compare_statuses(snapshot(model), stream) > 0, "no status"));
  await check("the calibration is that of the pose stream", () => wait_for("an equal calibration", () => try_to(() => compare_calibration(snapshot(model), stream)), 5));
  await check("anchors are those of the calibration file", () => wait_for("an equal set of anchors", () => try_to(() => compare_anchors(snapshot(model), site.calibration())), 10));
  await check("the banner's words are those of the state", () => {
    const { state, reason } = state_of(model.moment(null));
    assert.equal(state, model.pose.state);
    assert.notEqual(state_words(state, reason).title, state);
    assert.ok(anchors_of(model.moment(null)).length > 3);
  });
  socket.close();
  await closed;
}

// What two connections have differs for a moment.
function try_to(compare) {
  try {
    return compare();
  } catch (error) {
    try_to.last = error;
    return null;
  }
}
