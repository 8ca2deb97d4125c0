// How much the live page takes of a browser while it shows a simulated site: node campaign.mjs [MINUTES]
// Times are CPU time of the renderer's main thread, so that other programs on the computer do not count.
import { launch, open_page } from "./browser.mjs";
import { sleep, start_site } from "./site.mjs";

const kFrame_ms = 8; // script work of a frame, p95
const kTask_ms = 50; // the longest task
const kSettled_s = 10;
const kTraced_s = 40;
const kGrowth_mib = 5;

const minutes = Number(process.argv[2] ?? 45);
if (!(minutes >= 3)) {
  console.error("usage: test/web/campaign [MINUTES], 3 at least");
  process.exit(2);
}
const first_minute = minutes > 10 ? 5 : 2;

async function trace(session, seconds) {
  const events = [];
  session.on("Tracing.dataCollected", ({ value }) => events.push(...value));
  const complete = new Promise((resolve) => session.once("Tracing.tracingComplete", resolve));
  await session.send("Tracing.start", { transferMode: "ReportEvents", traceConfig: { includedCategories: ["toplevel", "devtools.timeline", "disabled-by-default-devtools.timeline", "__metadata"] } });
  await sleep(seconds);
  await session.send("Tracing.end");
  await complete;
  return events;
}

// Complete events of the page's main thread, with their thread time in ms.
function main_thread(events) {
  const frame = events.find((event) => event.name === "FunctionCall" && event.args?.data?.url?.includes("/assets/page.js"));
  if (!frame) throw new Error("the trace has no script of the page");
  return events
    .filter((event) => event.pid === frame.pid && event.tid === frame.tid && event.ph === "X" && event.tdur !== undefined)
    .map((event) => ({ name: event.name, begin: event.ts, end: event.ts + (event.dur ?? 0), ms: event.tdur / 1000, args: event.args }));
}

function percentile(values, share) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
}

// What the page's script does for one frame: its requestAnimationFrame callback, and the messages since the frame before.
function script_of_frames(events) {
  const kScripts = new Set(["FireAnimationFrame", "FunctionCall", "TimerFire", "EventDispatch", "V8.GCScavenger", "MinorGC", "MajorGC"]);
  const scripts = events.filter((event) => kScripts.has(event.name)).sort((a, b) => a.begin - b.begin || b.end - a.end);
  const frames = [];
  let sum_ms = 0;
  let outer_end = -Infinity;
  for (const event of scripts) {
    if (event.begin < outer_end) continue; // counted with the one around it
    outer_end = event.end;
    sum_ms += event.ms;
    if (event.name !== "FireAnimationFrame") continue;
    frames.push(sum_ms);
    sum_ms = 0;
  }
  return frames;
}

async function heap_mib(session) {
  for (let i = 0; i < 3; i++) await session.send("HeapProfiler.collectGarbage");
  // Of scripts, of the document, and of typed arrays.
  const { usedSize, embedderHeapUsedSize = 0, backingStorageSize = 0 } = await session.send("Runtime.getHeapUsage");
  return (usedSize + embedderHeapUsedSize + backingStorageSize) / 2 ** 20;
}

const rows = [];
const add = (name, value, limit, unit) => rows.push({ name, value, limit, unit, holds: value <= limit });

const site = await start_site();
const browser = await launch();
try {
  const { page, problems } = await open_page(browser, site.url, { width: 1400, height: 900 }, "light");
  const begin_ms = performance.now();
  const until = async (minute) => sleep(Math.max(0, minute * 60 - (performance.now() - begin_ms) / 1000));
  const session = await page.context().newCDPSession(page);
  const tracer = await browser.newBrowserCDPSession();
  await sleep(kSettled_s);
  const events = main_thread(await trace(tracer, kTraced_s));
  const frames = script_of_frames(events);
  const tasks = events.filter(({ name }) => name === "RunTask" || name === "ThreadControllerImpl::RunTask");
  const early = { frames: percentile(frames, 0.95), task: Math.max(...tasks.map(({ ms }) => ms)) };
  await until(first_minute);
  const before_mib = await heap_mib(session);
  // Once more at the end, when the history is as long as it gets.
  await until(minutes - 1);
  const late_events = main_thread(await trace(tracer, kTraced_s));
  const late_frames = script_of_frames(late_events);
  const late_tasks = late_events.filter(({ name }) => name === "RunTask" || name === "ThreadControllerImpl::RunTask");
  await until(minutes);
  const after_mib = await heap_mib(session);
  const counts = await page.evaluate(() => window.groma.model.counts);
  add(`script of a frame, p95, after ${kSettled_s} s (${frames.length} frames)`, early.frames, kFrame_ms, "ms");
  add(`script of a frame, p95, in minute ${minutes} (${late_frames.length} frames)`, percentile(late_frames, 0.95), kFrame_ms, "ms");
  add(`longest task after ${kSettled_s} s (${tasks.length} tasks)`, early.task, kTask_ms, "ms");
  add(`longest task in minute ${minutes} (${late_tasks.length} tasks)`, Math.max(...late_tasks.map(({ ms }) => ms)), kTask_ms, "ms");
  add(`heap in minute ${minutes}, beyond ${before_mib.toFixed(2)} MiB in minute ${first_minute}`, after_mib - before_mib, kGrowth_mib, "MiB");
  add("warnings and errors in the console", problems.length, 0, "");
  console.log(`live page for ${minutes} minutes: ${counts.POSE} poses, ${counts.STATUS} statuses; CPU time of its thread\n`);
  for (const { name, value, limit, unit, holds } of rows) console.log(`${name.padEnd(66)} ${value.toFixed(2).padStart(7)} ${unit.padEnd(3)}  limit ${String(limit).padStart(2)}  ${holds ? "" : "MISSED"}`.trimEnd());
  if (problems.length > 0) console.log(problems.slice(0, 5).join("\n"));
  if (!(counts.POSE > 15 * 60 * (minutes - 1))) {
    console.log(`only ${counts.POSE} poses came`);
    process.exitCode = 1;
  }
} finally {
  await browser.close();
  await site.stop();
}
process.exit(rows.length > 0 && rows.every(({ holds }) => holds) ? (process.exitCode ?? 0) : 1);
