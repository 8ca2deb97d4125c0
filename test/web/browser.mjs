// The live page in Chromium, as a person sees it and as the keyboard drives it.
import assert from "node:assert/strict";
import { execFile } from "node:child_process";
import { copyFileSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { dirname, join } from "node:path";
import { promisify } from "node:util";
import { chromium } from "playwright-core";
import { compare_anchors, compare_calibration, compare_poses, compare_statuses, snapshot } from "./compare.mjs";
import { free_port, groma, kRoot, PoseStream, Program, sleep, start_site, wait_for } from "./site.mjs";

const run = promisify(execFile);
const kPage = join(kRoot, "host/web/page");
const kSizes = [{ width: 1400, height: 900 }, { width: 1024, height: 768 }];
const kSchemes = ["light", "dark"];

export function launch(more = []) {
  // As root, Chromium has no sandbox.
  const sandbox = process.getuid() === 0 ? ["--no-sandbox"] : [];
  return chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: [...sandbox, ...more] });
}

// A tab with the page of `url`. `problems` has what a person would find in the console, and requests to others.
export async function open_page(browser, url, size, scheme) {
  const context = await browser.newContext({ viewport: size, colorScheme: scheme, deviceScaleFactor: 1 });
  const page = await context.newPage();
  const problems = [];
  const { host } = new URL(url);
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && problems.push(`console: ${message.text()}`));
  page.on("pageerror", (error) => problems.push(`error: ${error.message}`));
  page.on("request", (request) => {
    const { protocol, host: of } = new URL(request.url());
    if (protocol !== "data:" && protocol !== "blob:" && of !== host) problems.push(`request to ${request.url()}`);
  });
  page.on("websocket", (socket) => new URL(socket.url()).host !== host && problems.push(`WebSocket to ${socket.url()}`));
  await page.addInitScript(() => {
    window.csp_violations = [];
    addEventListener("securitypolicyviolation", (event) => window.csp_violations.push(`${event.violatedDirective}: ${event.blockedURI}`));
  });
  page.setDefaultTimeout(8000);
  if (process.env.GROMA_PAGE) await replace_page(page, process.env.GROMA_PAGE);
  const response = await page.goto(url);
  return { page, problems, response, close: () => context.close() };
}

// While working on the page: another build of it, with the headers of the server.
async function replace_page(page, folder) {
  // What Playwright answers is not of this computer for Chromium.
  await page.context().grantPermissions(["local-network-access"]);
  await page.route(/\/(assets\/[^/]+)?$/, async (route) => {
    const path = new URL(route.request().url()).pathname;
    const { "content-type": type, "content-security-policy": policy } = (await route.fetch()).headers();
    const headers = { "content-type": type, ...(policy ? { "content-security-policy": policy } : {}) };
    await route.fulfill({ headers, body: readFileSync(join(folder, path === "/" ? "index.html" : path)) });
  });
}

export const model_of = (page) => page.evaluate(`(${snapshot})(window.groma.model)`);
const text_of = (page, selector) => page.locator(selector).innerText();

// What the banner shows, after the frame that follows the newest message.
function banner_of(page) {
  return page.evaluate(async () => {
    for (let i = 0; i < 2; i++) await new Promise((resolve) => requestAnimationFrame(resolve));
    const text = (selector) => document.querySelector(selector).textContent;
    const { model } = window.groma;
    return {
      title: text(".banner .state"), code: text(".banner .code"), meaning: text(".banner .meaning"), remedy: text(".banner .remedy"),
      notices: [...document.querySelectorAll(".banner .notices strong")].map((title) => title.textContent),
      pose_state: model.pose?.state ?? null, pose_reason: model.pose?.reason ?? null, status_state: model.status?.state ?? null,
    };
  });
}

// From now on window.titles has each title that the banner had: some hold for half a second only.
function keep_titles(page) {
  return page.evaluate(() => {
    const title = document.querySelector(".banner .state");
    window.titles = [title.textContent];
    new MutationObserver(() => window.titles.push(title.textContent)).observe(title, { childList: true, characterData: true, subtree: true });
  });
}

const figure_of = (page, name) =>
  page.evaluate((wanted) => [...document.querySelectorAll(".figures div")].find((of) => of.querySelector("dt").textContent === wanted).querySelector("dd").textContent, name);
const metres = (value) => `${value.toFixed(2).replace("-", "−")} m`;
const has_title = (page, wanted, timeout_s = 10) =>
  wait_for(`the title "${wanted}"`, async () => (await banner_of(page)).title === wanted, timeout_s).catch(async (error) => {
    throw new Error(`${error.message}; it is ${JSON.stringify(await banner_of(page))}`);
  });

// Comparisons that two connections allow only for a moment.
async function in_time(compare, timeout_s = 10) {
  let last;
  await wait_for("equal values", async () => {
    try {
      await compare();
      return true;
    } catch (error) {
      last = error;
      return false;
    }
  }, timeout_s).catch(() => {
    throw last;
  });
}

export async function check_page(check) {
  const folder = mkdtempSync(join(tmpdir(), "groma-web-"));
  const browser = await launch();
  try {
    const recording = make_recording(folder).then((made) => ({ made }), (error) => ({ error }));
    await check_states(check, browser, folder);
    await check_live(check, browser, folder, recording);
  } finally {
    await browser.close();
    rmSync(folder, { recursive: true, force: true });
  }
}

async function make_recording(folder) {
  const demo = join(folder, "demo");
  const file = join(folder, "drive.mcap");
  await run(groma(), ["demo", "--seed", "1", "--report", demo], { maxBuffer: 1 << 26 });
  await run(groma(), ["convert", join(demo, "second_drive"), "--calibration", join(demo, "calibration.yaml"), "--from", "130", "--to", "150", "-o", file]);
  const { stdout } = await run("node", [join(kRoot, "test/npm/read_mcap.mjs"), file], { maxBuffer: 1 << 28 });
  return { file, estimates: JSON.parse(stdout).messages.filter(({ topic }) => topic === "/groma/estimate") };
}

// Every state once, of the page's own server.

const kOwnTitles = {
  LOST: "Lost",
  CONVERGING: "Finding the pose",
  TRACKING: "Tracking",
  UNINITIALIZED: "Pose unknown",
  CALIBRATION_DRIVE: "Calibration drive",
  CALIBRATING: "Calibrating",
  WAITING_FOR_ODOMETRY: "Waiting for odometry",
  ODOMETRY_TIMES_WRONG: "Odometry times wrong",
  "DEGRADED:no-ranges": "Degraded: no ranges",
  "DEGRADED:ranges-disagree": "Degraded: ranges disagree",
  "DEGRADED:no-odometry": "Degraded: no odometry",
  "DEGRADED:tag-silent": "Degraded: a tag is silent",
  "DEGRADED:uncertain": "Degraded: pose uncertain",
  "DEGRADED:off-surface": "Degraded: off the surface",
  "DEGRADED:map-mismatch": "Degraded: the map does not fit",
  "DEGRADED:odometry-times": "Degraded: odometry times suspect",
};

// The page's server for development plays a synthetic site.
export async function serve_states(folder) {
  const built = join(folder, "page");
  await run(join(kPage, "node_modules/.bin/vite"), ["build", "--logLevel", "warn"], { cwd: kPage, env: { ...process.env, GROMA_PAGE_OUT: built } });
  return async (...options) => {
    const port = await free_port();
    const server = new Program("node", [join(kPage, "dev/server.mjs"), "--port", String(port), "--history", "60", ...options], { GROMA_PAGE_OUT: built });
    await server.says(/(http:\S+)/);
    server.url = `http://127.0.0.1:${port}/`;
    return server;
  };
}

async function check_states(check, browser, folder) {
  const serve = await serve_states(folder);
  let turn = 0;
  const show = async (options, look) => {
    const server = await serve(...options);
    const tab = await open_page(browser, server.url, kSizes[turn % 2], kSchemes[(turn >> 1) % 2]);
    turn++;
    try {
      await look(tab);
      await fits(tab.page);
    } finally {
      await tab.close();
      await server.stop();
    }
  };
  for (const [state, title] of Object.entries(kOwnTitles)) {
    await check(`state ${state}: "${title}"`, () =>
      show(["--state", state], async ({ page, problems }) => {
        await has_title(page, title);
        const { code, meaning, remedy, notices } = await banner_of(page);
        assert.equal(code, state.replace(":", " "));
        assert.ok(meaning.length > 10 && remedy.length > 5);
        assert.match(await text_of(page, "#announcement"), new RegExp(`^${title}\\.`));
        if (state === "DEGRADED:tag-silent") assert.ok(notices.includes("No link to the node"), String(notices));
        if (state === "DEGRADED:no-odometry" || state === "WAITING_FOR_ODOMETRY") assert.ok(notices.includes("No link to the robot"), String(notices));
        if (state === "ODOMETRY_TIMES_WRONG") assert.ok(notices.includes("time unit"), String(notices));
        assert.deepEqual(problems, []);
      }),
    );
  }
  await check('no WebSocket: "No connection to gromad"', () => show(["--silent"], ({ page }) => has_title(page, "No connection to gromad")));
}

// Nothing is cut off at the right, and the map has room.
async function fits(page) {
  const { width, inner, map } = await page.evaluate(() => ({ width: document.documentElement.scrollWidth, inner: innerWidth, map: document.getElementById("map").getBoundingClientRect() }));
  assert.ok(width <= inner, `the page is ${width} px wide`);
  assert.ok(map.width > 300 && map.height > 200, `the map is ${map.width} x ${map.height}`);
}

// With gromad.

async function check_live(check, browser, folder, recording) {
  let site = await start_site();
  let stream = new PoseStream(site.stream_port);
  try {
    const early = await open_page(browser, site.url, kSizes[0], "light");
    await check("while the anchors are calibrated for the first time, the banner says so", async () => {
      await has_title(early.page, "Calibration drive");
      await keep_titles(early.page);
      await has_title(early.page, "Tracking", 40);
      assert.deepEqual(await early.page.evaluate(() => window.titles), ["Calibration drive", "Finding the pose", "Tracking"]);
    });
    await early.close();
    for (const size of kSizes) {
      for (const scheme of kSchemes) await check_variant(check, browser, site, stream, size, scheme);
    }
    const tab = await open_page(browser, site.url, kSizes[0], "light");
    await check_scroll_back(check, tab.page, stream);
    await check_files(check, tab.page, folder, recording);
    await check("files and the time line: no problem in the console", () => no_problems(tab));
    await check_missing_links(check, browser, site);
    ({ site, stream } = await check_interruptions(check, tab, site, stream));
    await tab.close();
  } finally {
    stream.close();
    await site.stop();
  }
}

async function no_problems({ page, problems }) {
  assert.deepEqual(problems, []);
  assert.deepEqual(await page.evaluate(() => window.csp_violations), []);
}

// The figures x and y are those of one of these poses.
async function is_one_of(page, poses) {
  const [x, y] = [await figure_of(page, "x"), await figure_of(page, "y")];
  assert.ok(poses.some((pose) => metres(pose.x_m) === x && metres(pose.y_m) === y), `x is ${x}, y is ${y}`);
}

async function check_variant(check, browser, site, stream, size, scheme) {
  const name = `${size.width} x ${size.height}, ${scheme}`;
  const tab = await open_page(browser, site.url, size, scheme);
  const { page } = tab;
  await check(`${name}: the page loads with its policy, and fits`, async () => {
    assert.equal(tab.response.status(), 200);
    assert.match(tab.response.headers()["content-security-policy"], /default-src 'self'/);
    await wait_for("the history", () => page.evaluate(() => window.groma.model.history === "complete"));
    assert.equal(await page.evaluate(() => document.documentElement.dataset.theme), scheme);
    assert.equal(await page.evaluate(() => getComputedStyle(document.body).colorScheme), await page.evaluate(() => getComputedStyle(document.documentElement).colorScheme));
    await fits(page);
  });
  await sleep(2.5);
  await check(`${name}: what the page has is what the pose stream has`, async () => {
    const has = await model_of(page);
    await sleep(0.3);
    assert.ok(compare_poses(has, stream) > 10, "too few poses");
    assert.ok(compare_statuses(has, stream) > 0, "no status");
    await in_time(async () => compare_calibration(await model_of(page), stream));
    await in_time(async () => compare_anchors(await model_of(page), site.calibration()));
  });
  await check(`${name}: the banner is that of the state`, () =>
    in_time(async () => {
      const { title, code, pose_state, pose_reason } = await banner_of(page);
      const state = pose_reason ? `${pose_state}:${pose_reason}` : pose_state;
      assert.deepEqual([title, code], [kOwnTitles[state], state.replace(":", " ")]);
    }),
  );
  await check(`${name}: the key figures are those of a pose of the last 1.2 s`, () =>
    in_time(() => is_one_of(page, [...stream.poses.values()].slice(-60))),
  );
  await check(`${name}: the table has the anchors of the stream`, async () => {
    const rows = await page.evaluate(() => [...document.querySelectorAll("#panel-0 tbody tr:not(.note)")].map((row) => Number(row.cells[0].textContent)));
    assert.deepEqual(rows.sort((a, b) => a - b), [...new Set([...stream.status.anchors, ...stream.calibrations.at(-1).anchors].map(({ id }) => id))].sort((a, b) => a - b));
  });
  await check(`${name}: the map is drawn`, async () => {
    const colours = await page.evaluate(() => {
      const canvas = document.getElementById("map");
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return new Set(new Uint32Array(data.buffer)).size;
    });
    assert.ok(colours > 50, `${colours} colours`);
  });
  await check_keyboard(check, page, name);
  await check(`${name}: nothing in the console, no request elsewhere`, () => no_problems(tab));
  await tab.close();
}

const selected_tab = (page) => page.evaluate(() => document.querySelector('[role="tab"][aria-selected="true"]').textContent);
const view_of = (page) => page.evaluate(() => document.body.dataset.view);

async function check_keyboard(check, page, name) {
  const { keyboard } = page;
  await check(`${name}: the keyboard reaches each control, and the focus is visible`, async () => {
    await page.evaluate(() => document.activeElement?.blur());
    const reached = new Set();
    for (let i = 0; i < 60; i++) {
      await keyboard.press("Tab");
      const at = await page.evaluate(() => {
        const of = document.activeElement;
        if (of === document.body) return null;
        const style = getComputedStyle(of);
        return { id: of.id || of.className || of.tagName, is_visible: style.outlineStyle !== "none" && style.outlineWidth !== "0px" };
      });
      if (at === null) break;
      assert.ok(at.is_visible, `no outline at ${at.id}`);
      reached.add(at.id);
    }
    for (const id of ["open", "theme", "map", "follow", "whole", "links", "tab-0", "slider", "pick"]) assert.ok(reached.has(id), `${id} is not among ${[...reached]}`);
  });
  await check(`${name}: arrows choose tabs`, async () => {
    await page.focus("#tab-0");
    const titles = [];
    for (const key of ["ArrowRight", "ArrowRight", "End", "ArrowRight", "End", "Home"]) {
      await keyboard.press(key);
      titles.push(await selected_tab(page));
    }
    assert.deepEqual(titles, ["Links", "Pairs", "Log", "Anchors", "Log", "Anchors"]);
    assert.equal(await page.evaluate(() => document.activeElement.id), "tab-0");
    assert.equal(await view_of(page), "live"); // the arrows were not those of the time line
  });
  await check(`${name}: a row chooses an anchor, Esc leaves it`, async () => {
    await page.locator("#panel-0 .pick").first().focus();
    const id = await page.evaluate(() => document.activeElement.textContent);
    await keyboard.press("Enter");
    await in_time(async () => assert.equal(await text_of(page, ".details h3"), `Anchor ${id}`), 2);
    assert.equal(await page.evaluate(() => document.activeElement.getAttribute("aria-pressed")), "true");
    await keyboard.press("Escape");
    await in_time(async () => assert.equal(await page.locator(".details").isHidden(), true), 2);
  });
  await check(`${name}: arrows go back in time, Esc to now`, async () => {
    await page.focus("#slider");
    await keyboard.press("ArrowLeft");
    await in_time(async () => assert.equal(await view_of(page), "past"), 2);
    await keyboard.press("Shift+ArrowLeft");
    await in_time(async () => assert.match(await text_of(page, ".moment"), /^0:1[1-3] ago$/), 2);
    assert.equal(await page.locator(".back").isVisible(), true);
    await keyboard.press("Escape");
    await in_time(async () => assert.deepEqual([await view_of(page), await page.locator(".back").isVisible()], ["live", false]), 2);
  });
}

async function check_scroll_back(check, page, stream) {
  await check("one minute back shows the pose of then, and the button leads back to now", async () => {
    await wait_for("a minute of poses", () => stream.last.t_s - stream.first_s > 66, 90);
    await page.focus("#slider");
    await page.keyboard.press("PageDown");
    const then_s = stream.last.t_s - 60;
    await in_time(async () => assert.equal(await view_of(page), "past"), 2);
    await in_time(() => is_one_of(page, [...stream.poses.values()].filter((pose) => Math.abs(pose.t_s - then_s) < 2)), 3);
    // The moment stays while new data come.
    const x = await figure_of(page, "x");
    await sleep(1.5);
    assert.equal(await figure_of(page, "x"), x);
    assert.match(await text_of(page, ".moment"), /^1:0\d ago$/);
    await page.click(".back");
    await in_time(async () => {
      assert.equal(await view_of(page), "live");
      await is_one_of(page, [...stream.poses.values()].slice(-60));
    }, 3);
  });
}

// A file from outside the browser, with the events of a drop.
async function drop(page, name, bytes) {
  await page.evaluate(
    ([file_name, text]) => {
      const transfer = new DataTransfer();
      transfer.items.add(new File([Uint8Array.from(atob(text), (of) => of.charCodeAt(0))], file_name));
      for (const type of ["dragenter", "dragover", "drop"]) document.body.dispatchEvent(new DragEvent(type, { dataTransfer: transfer, bubbles: true, cancelable: true }));
    },
    [name, bytes.toString("base64")],
  );
}

async function check_files(check, page, folder, recording) {
  const { made, error } = await recording;
  await check("groma demo and convert make an MCAP file", () => {
    if (error) throw error;
  });
  if (!made) return;
  const bytes = readFileSync(made.file);
  const first = made.estimates[0].value;
  const last = made.estimates.at(-1).value;
  // The page keeps ten poses a second of a short recording.
  const ends = made.estimates.slice(-6).map(({ value }) => value);
  await check("a dropped recording shows its poses", async () => {
    await drop(page, "drive.mcap", bytes);
    await in_time(async () => assert.equal(await view_of(page), "file"));
    await in_time(async () => assert.deepEqual([await figure_of(page, "x"), await figure_of(page, "y")], [metres(first.x_m), metres(first.y_m)]), 5);
    assert.match(await text_of(page, ".moment"), /^Recording, 0:00 of 0:(19|20)$/);
    await page.focus("#slider");
    await page.keyboard.press("End");
    await in_time(() => is_one_of(page, ends), 5);
    assert.equal((await banner_of(page)).code, [last.state, last.reason].filter(Boolean).join(" "));
  });
  await check("the recording plays to its end", async () => {
    await page.focus("#slider");
    await page.keyboard.press("Home");
    await page.selectOption("#speed", "20");
    await page.focus("#slider");
    await page.keyboard.press("Space");
    await in_time(async () => assert.equal(await text_of(page, "#play"), "Pause"), 2);
    await in_time(async () => assert.equal(await text_of(page, "#play"), "Play"), 10);
    await in_time(() => is_one_of(page, ends), 5);
  });
  await check("Esc leads from the recording to the live site", async () => {
    await page.keyboard.press("Escape");
    await in_time(async () => assert.equal(await view_of(page), "live"), 2);
  });
  const broken = {
    "half.mcap": [bytes.subarray(0, bytes.length >> 1), /^half\.mcap: The file is incomplete or damaged .*Convert the recording again\.$/],
    "drive.glog": [Buffer.from("GLOG, not an MCAP file"), /is no MCAP file.*groma convert/],
    "empty.mcap": [Buffer.alloc(0), /is empty/],
  };
  for (const [name, [content, message]] of Object.entries(broken)) {
    await check(`a dropped ${name} is refused with what to do, and the site stays`, async () => {
      await drop(page, name, content);
      await in_time(async () => assert.match(await text_of(page, "#file-text"), message), 5);
      assert.equal(await view_of(page), "live");
      await page.click("#file-close");
      assert.equal(await page.locator("#file-message").isHidden(), true);
    });
  }
  await check("a recording can be opened by the button", async () => {
    const file = join(folder, "chosen.mcap");
    writeFileSync(file, bytes);
    const [chooser] = await Promise.all([page.waitForEvent("filechooser"), page.click("#open")]);
    await chooser.setFiles(file);
    await in_time(async () => assert.equal(await view_of(page), "file"));
    await page.click(".back");
    await in_time(async () => assert.equal(await view_of(page), "live"), 2);
  });
}

// gromad for the same site, without its nodes and its robot.
async function check_missing_links(check, browser, site) {
  await check("the nodes and the robot are missing: the page names the links", async () => {
    const folder = mkdtempSync(join(tmpdir(), "groma-web-"));
    const port = await free_port();
    const configuration = readFileSync(join(site.folder, "gromad.yaml"), "utf8").replace(/^web: \{port: \d+/m, `web: {port: ${port}`);
    for (const name of ["surface.csv", "walls.csv"]) copyFileSync(join(site.folder, name), join(folder, name));
    writeFileSync(join(folder, "gromad.yaml"), configuration);
    const gromad = new Program(join(dirname(groma()), "gromad"), ["--config", join(folder, "gromad.yaml")]);
    await gromad.says(/live page: (http:\S+)/);
    const { page, problems, close } = await open_page(browser, `http://127.0.0.1:${port}/`, kSizes[1], "light");
    await in_time(async () => {
      const { notices } = await banner_of(page);
      for (const wanted of ["No link to the node", "No link to the robot"]) assert.ok(notices.includes(wanted), String(notices));
    });
    // Three nodes and the robot; more than three are behind a button.
    await in_time(async () => assert.equal(await text_of(page, ".more"), "Show 1 more"), 2);
    await page.click(".more");
    await in_time(async () => assert.equal(await page.locator(".notices li:visible").count(), 4), 2);
    await page.click("#tab-1");
    await in_time(async () => assert.match(await text_of(page, "#panel-1"), /tag-1: not open: .*\btag-3: not open: /s), 2);
    assert.deepEqual(problems, []);
    await close();
    await gromad.stop();
    rmSync(folder, { recursive: true });
  });
}

// The site stands still, its gromad ends and starts again.
async function check_interruptions(check, { page }, site, stream) {
  await check("a site that stands still: no odometry, and poses again after it", async () => {
    await keep_titles(page);
    site.signal("SIGSTOP");
    await has_title(page, "Waiting for odometry", 15);
    site.signal("SIGCONT");
    await has_title(page, "Tracking", 30);
    const titles = await page.evaluate(() => window.titles);
    assert.ok(titles.includes("Finding the pose"), String(titles));
  });
  await check("gromad ends: the page says so, with the age of its data", async () => {
    await site.stop();
    stream.close();
    await has_title(page, "No connection to gromad", 10);
    assert.match(await text_of(page, ".moment"), /^Data is \d:\d\d old$/);
    assert.equal(await text_of(page, "#connection"), "not connected");
  });
  await check("gromad starts again on the same port: the page connects by itself and shows the new run", async () => {
    site = await start_site({ port: site.port, seed: 2 });
    stream = new PoseStream(site.stream_port);
    await in_time(async () => assert.equal(await text_of(page, "#connection"), "connected"), 25);
    await has_title(page, "Tracking", 40);
    const has = await model_of(page);
    await sleep(0.3);
    assert.ok(compare_poses(has, stream) > 3);
    assert.ok(has.poses.every((pose) => pose.t_s <= stream.last.t_s), "poses of the run before are left");
  });
  return { site, stream };
}
