// Puts the page together: messages go to the model, and a frame shows the moment that is chosen, of the live site or of a file.
import "./page.css";
import { Banner } from "./banner";
import { Connection, type ConnectionState } from "./connection";
import { h, set_attribute, set_text } from "./dom";
import { duration } from "./format";
import { MapView } from "./map";
import { FileProblem, read_recording, type Recording } from "./mcap";
import type { Message } from "./messages";
import { anchors_of, Model, type Moment } from "./model";
import { Panels } from "./panels";
import { kConnecting, kNoFile, kNoStatus, kNotConnected, notices_of, state_of, state_words } from "./states";
import { Theme } from "./theme";
import { Timeline } from "./timeline";

declare global {
  interface Window {
    groma: { model: Model };
  }
}

const kTables_ms = 500;
const kTimeline_ms = 250;

const by_id = <T extends HTMLElement>(id: string) => document.getElementById(id) as T;
const now_s = () => performance.now() / 1000;

const live = new Model();
window.groma = { model: live };

let recording: Recording | null = null;
let file_name = "";
let cursor_s: number | null = null; // null: the newest
let selected: number | null = null;
let is_playing = false;
let played_s = 0; // when the cursor last moved by playing

const dirty = { map: true, tables: true, timeline: true };
let is_scheduled = false;
let tables_ms = -Infinity;
let timeline_ms = -Infinity;
let drawn_cursor_s: number | null | undefined;

const model = () => recording?.model ?? live;

function schedule(): void {
  if (is_scheduled) return;
  is_scheduled = true;
  requestAnimationFrame(frame);
}

function invalidate(): void {
  dirty.map = dirty.tables = dirty.timeline = true;
  schedule();
}

// Also shows what a person did at once, not with the next tables.
function refresh(): void {
  tables_ms = timeline_ms = -Infinity;
  invalidate();
}

const theme = new Theme(by_id<HTMLButtonElement>("theme"), () => refresh());
const banner = new Banner(by_id("announcement"), () => back_to_live());
by_id("banner").replaceWith(banner.element);

const map = new MapView(by_id<HTMLCanvasElement>("map"), theme, {
  changed: () => {
    dirty.map = true;
    schedule();
  },
  anchor_picked: (id) => {
    select(id);
    if (id !== null) panels.show_anchors();
  },
  follow_changed: () => set_attribute(by_id("follow"), "aria-pressed", String(map.follow)),
});
const panels = new Panels({ get: () => selected, set: (id) => select(id) }, () => refresh());
by_id("figures").replaceWith(panels.figures);
by_id("panels").replaceWith(panels.element);
const timeline = new Timeline(
  by_id<HTMLCanvasElement>("timeline"),
  by_id("slider"),
  theme,
  { moved: (at_s) => move_to(at_s), step: (by_s) => step(by_s), live: () => to_end() },
  () => refresh(),
);

function select(id: number | null): void {
  selected = map.selected = id;
  const anchor = id === null ? undefined : anchors_of(model().moment(cursor_s)).find((of) => of.id === id);
  if (anchor) map.reveal(anchor);
  refresh();
}

// The time line.

function newest_s(): number {
  return recording ? recording.model.newest_at_s() : live.axis_at_s(now_s());
}

function move_to(at_s: number): void {
  const oldest_s = model().oldest_at_s();
  if (Number.isNaN(oldest_s)) return;
  cursor_s = Math.max(oldest_s, at_s);
  if (cursor_s >= newest_s()) cursor_s = recording ? newest_s() : null;
  played_s = now_s();
  refresh();
}

function step(by_s: number): void {
  move_to((cursor_s ?? newest_s()) + by_s);
}

function to_end(): void {
  if (recording) return move_to(newest_s());
  cursor_s = null;
  refresh();
}

function back_to_live(): void {
  if (recording !== null) {
    recording = null;
    is_playing = false;
    map.reset();
    select(null);
  }
  cursor_s = null;
  refresh();
}

function play(playing: boolean): void {
  is_playing = playing && recording !== null;
  if (is_playing && cursor_s !== null && cursor_s >= newest_s()) cursor_s = model().oldest_at_s();
  played_s = now_s();
  refresh();
}

function advance(): void {
  if (!is_playing || cursor_s === null) return;
  const now = now_s();
  cursor_s += (now - played_s) * Number(by_id<HTMLSelectElement>("speed").value);
  played_s = now;
  if (cursor_s >= newest_s()) {
    cursor_s = newest_s();
    is_playing = false;
  }
  invalidate();
}

// One frame.

function frame(): void {
  is_scheduled = false;
  advance();
  const now_ms = performance.now();
  const moment = model().moment(cursor_s);
  show_state(moment);
  if (dirty.map) {
    dirty.map = false;
    map.draw(model(), moment);
  }
  // A long history is still coming in: the rest waits until it is there.
  const is_loading = recording === null && live.history === "loading" && connection.state === "open";
  const tables_are_due = dirty.tables && !is_loading && now_ms - tables_ms >= kTables_ms;
  if (tables_are_due) {
    dirty.tables = false;
    tables_ms = now_ms;
    panels.show_figures(moment);
    panels.show_tables(model(), moment);
    show_head();
  }
  const has_moved = drawn_cursor_s !== cursor_s;
  // Not in one frame with the tables, unless a person waits for both.
  const is_free = !tables_are_due || timeline_ms === -Infinity;
  if (dirty.timeline && !is_loading && is_free && now_ms - timeline_ms >= kTimeline_ms) {
    dirty.timeline = false;
    timeline_ms = now_ms;
    timeline.draw_content(model(), newest_s(), recording === null);
    drawn_cursor_s = undefined;
  }
  if (has_moved || drawn_cursor_s === undefined) {
    drawn_cursor_s = cursor_s;
    timeline.draw_cursor(cursor_s);
  }
  if (!is_free && dirty.timeline) schedule();
}

function show_state(moment: Moment): void {
  const is_live_view = recording === null && cursor_s === null;
  const is_connected = connection.state === "open";
  const state = state_of(moment);
  if (is_live_view && !is_connected) {
    banner.show(connection.state === "closed" ? kNotConnected : kConnecting, "", []);
  } else if (state) {
    const code = state.reason === "" ? state.state : `${state.state} ${state.reason}`;
    const words = state_words(state.state, state.reason);
    const notices = notices_of(moment);
    // The notices below have what there is to do.
    banner.show(words.tone === "good" && notices.length > 0 ? { ...words, remedy: "" } : words, code, notices);
  } else {
    banner.show(recording ? kNoFile : kNoStatus, "", []);
  }
  const is_stale = recording === null && !is_connected && moment.status !== null;
  document.body.dataset.view = recording ? "file" : cursor_s === null ? "live" : "past";
  document.body.dataset.connection = connection.state;
  set_attribute(document.body, "data-stale", is_stale ? "" : null);
  let when = "";
  if (recording) when = `Recording, ${duration(cursor_s ?? 0)} of ${duration(newest_s())}`;
  else if (cursor_s !== null) when = `${duration(newest_s() - cursor_s)} ago`;
  else if (is_stale) when = `Data is ${duration(now_s() - connection.last_message_s)} old`;
  banner.show_moment(when, is_live_view);
  by_id("player").hidden = recording === null;
  set_text(by_id("play"), is_playing ? "Pause" : "Play");
  timeline.describe(cursor_s, recording === null, state?.state ?? "no state");
}

function show_head(): void {
  const site = model().site;
  const name = recording ? file_name : site?.frame || "Site";
  const title = `${name} – Groma`;
  if (document.title !== title) document.title = title;
  set_text(by_id("site"), name);
  by_id("simulated").hidden = site?.simulated !== true;
  const link = { open: "connected", connecting: "connecting", closed: "not connected" }[connection.state];
  set_text(by_id("connection"), recording ? "recording" : link);
  set_text(by_id("version"), recording ? "" : live.version);
}

// Live messages.

const connection = new Connection(new URL("live", location.href.replace(/^http/, "ws")).href, {
  message(message: Message, arrived_s: number): void {
    live.take(message, arrived_s);
    if (message.class === "SITE" && recording === null) map.reset();
    if (recording === null) {
      if (cursor_s === null || message.class === "HISTORY") dirty.map = true;
      if (message.class !== "POSE" || cursor_s === null) dirty.tables = true;
      dirty.timeline = true;
      if (message.class === "HISTORY") cursor_s = null;
      schedule();
    }
  },
  state(_state: ConnectionState): void {
    refresh();
  },
});

// A quiet site, or none, has no messages that would draw the age of the data and the moving time line.
setInterval(() => {
  dirty.tables = dirty.timeline = true;
  schedule();
}, kTables_ms);

// Files.

let reading = 0; // which file was opened last

async function open_file(file: File): Promise<void> {
  const mine = ++reading;
  const message = by_id("file-message");
  const say = (text: string, is_problem: boolean) => {
    if (mine !== reading) return;
    message.hidden = text === "";
    set_text(by_id("file-text"), text);
    set_attribute(message, "data-problem", is_problem ? "" : null);
  };
  say(`Reading ${file.name} …`, false);
  try {
    const read = await read_recording(file, (share) => say(`Reading ${file.name}: ${10 * Math.floor(10 * share)} %`, false));
    if (mine !== reading) return;
    recording = read;
    file_name = file.name;
    cursor_s = read.model.oldest_at_s();
    map.reset();
    select(null);
    play(false);
    say(read.has_poses ? "" : "The file has no poses: convert the recording with --calibration to see them.", false);
  } catch (error) {
    say(`${file.name}: ${error instanceof FileProblem ? error.message : `cannot be read (${String(error)}).`}`, true);
  }
}

const picker = by_id<HTMLInputElement>("file");
by_id("open").addEventListener("click", () => picker.click());
picker.addEventListener("change", () => {
  const file = picker.files?.[0];
  picker.value = ""; // the same file may be opened again
  if (file) void open_file(file);
});
by_id("file-close").addEventListener("click", () => (by_id("file-message").hidden = true));
const drop = by_id("drop");
for (const name of ["dragenter", "dragover"]) {
  addEventListener(name, (event) => {
    event.preventDefault();
    drop.hidden = false;
  });
}
addEventListener("dragleave", (event) => {
  if (event.relatedTarget === null) drop.hidden = true;
});
addEventListener("drop", (event) => {
  event.preventDefault();
  drop.hidden = true;
  const file = event.dataTransfer?.files[0];
  if (file) void open_file(file);
});

// Buttons and keys.

function toggle_links(): void {
  map.show_links = !map.show_links;
  set_attribute(by_id("links"), "aria-pressed", String(map.show_links));
  refresh();
}

by_id("follow").addEventListener("click", () => map.set_follow(!map.follow));
by_id("whole").addEventListener("click", () => map.whole_site());
by_id("links").addEventListener("click", toggle_links);
by_id("closer").addEventListener("click", () => map.zoom(1.4));
by_id("farther").addEventListener("click", () => map.zoom(1 / 1.4));
by_id("play").addEventListener("click", () => play(!is_playing));

const kKeys: Record<string, () => void> = {
  f: () => map.set_follow(!map.follow),
  h: () => map.whole_site(),
  l: toggle_links,
  "+": () => map.zoom(1.4),
  "-": () => map.zoom(1 / 1.4),
  o: () => picker.click(),
  " ": () => play(!is_playing),
  Escape: () => (selected !== null && recording === null && cursor_s === null ? select(null) : back_to_live()),
};

addEventListener("keydown", (event) => {
  const target = event.target as HTMLElement;
  if (event.ctrlKey || event.altKey || event.metaKey || target.closest("select, input")) return;
  if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
    step((event.key === "ArrowLeft" ? -1 : 1) * (event.shiftKey ? 10 : 1));
  } else if (event.key === " " && (recording === null || target.closest("button, summary"))) {
    return; // the key of the button, or of the page, which it scrolls
  } else {
    const action = kKeys[event.key.toLowerCase()] ?? kKeys[event.key];
    if (!action) return;
    action();
  }
  event.preventDefault();
});

by_id("keys").append(
  ...([
    ["F", "follow the robot"],
    ["H", "whole site"],
    ["L", "lines to the anchors"],
    ["+ −", "zoom; with the map in focus, arrows move it"],
    ["← →", "1 s back or on; with Shift 10 s"],
    ["Esc", "back to live"],
    ["Space", "play or pause a recording"],
    ["O", "open a recording"],
  ] as const).flatMap(([key, text]) => [h("dt", {}, key), h("dd", {}, text)]),
);
schedule();
