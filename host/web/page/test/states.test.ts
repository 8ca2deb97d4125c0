import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import test from "node:test";
import type { Message } from "../src/messages";
import { Model } from "../src/model";
import { kReasons, kStates, notices_of, state_of, state_words } from "../src/states";

const source = (path: string) => readFileSync(join(process.env.GROMA_ROOT!, path), "utf8");

// The table of states in the pose stream's reference.
function documented(): { states: string[]; reasons: string[] } {
  const text = source("docs/reference/gromad.md");
  const begin = text.indexOf("`state` of a pose, and of a status:");
  const table = text.slice(begin, text.indexOf("\n\n", text.indexOf("|---|", begin)));
  const rows = table.split("\n").filter((line) => /^\| `/.test(line));
  const words = (line: string, pattern: RegExp) => [...line.matchAll(pattern)].map((match) => match[1]!);
  const states = rows.flatMap((row) => words(row.split(" | ")[0]!, /`([A-Z_]+)`/g));
  const degraded = rows.find((row) => row.startsWith("| `DEGRADED`"))!;
  return { states, reasons: words(degraded, /`([a-z-]+)` \(/g) };
}

test("each state and each reason of the reference has words, and no other", () => {
  const { states, reasons } = documented();
  assert.ok(states.length >= 9 && reasons.length >= 8, "the table was not found");
  assert.deepEqual(Object.keys(kStates).sort(), states.sort());
  assert.deepEqual(Object.keys(kReasons).sort(), reasons.sort());
});

test("the remedies are those of groma monitor and groma doctor", () => {
  const plain = (text: string) => text.toLowerCase().replace(/\.$/, "");
  const pairs = [...source("host/doctor/advice.cpp").matchAll(/\{"([A-Za-z_-]+)",\s*"([^"]+)"\}/g)];
  assert.ok(pairs.length >= 15, "the table was not found");
  for (const [, word, remedy] of pairs) assert.equal(plain((kReasons[word!] ?? kStates[word!])!.remedy), plain(remedy!), word);
});

test("a word is a sentence that a person can follow", () => {
  for (const [word, { title, meaning, remedy }] of [...Object.entries(kStates), ...Object.entries(kReasons)]) {
    for (const text of [meaning, remedy]) assert.match(text, /^([A-Z]|gromad ).*\.$/, word);
    assert.ok(title.length > 0 && title.length < 40, word);
  }
});

test("a state that the page does not know is shown as it is", () => {
  assert.equal(state_words("HOVERING", "").title, "HOVERING");
  assert.match(state_words("DEGRADED", "new-reason").title, /new-reason/);
});

const pose = (t_s: number, state: string, reason: string | null): Message => ({ class: "POSE", t_s, state, reason, x_m: 0, y_m: 0, yaw_rad: 0, covariance: [] });
const status = (state: string, more: object = {}): Message => ({ class: "STATUS", state, t_s: null, ...more });

test("the pose has the reason; without poses the status has the state", () => {
  const model = new Model();
  assert.equal(state_of(model.moment(null)), null);
  model.take(status("TRACKING", { odometry: 100 }), 0.5);
  model.take(pose(1, "DEGRADED", "tag-silent"), 1);
  assert.deepEqual(state_of(model.moment(null)), { state: "DEGRADED", reason: "tag-silent" });
  model.take(status("ODOMETRY_TIMES_WRONG", { odometry: 101 }), 3);
  assert.deepEqual(state_of(model.moment(null)), { state: "ODOMETRY_TIMES_WRONG", reason: "" });
  model.take(status("DEGRADED", { odometry: 101 }), 4);
  assert.deepEqual(state_of(model.moment(null)), { state: "DEGRADED", reason: "no-odometry" });
});

test("a state that only STATUS has is shown until a later pose", () => {
  const model = new Model();
  model.take(status("CALIBRATION_DRIVE"), 1);
  model.take(pose(1, "TRACKING", null), 1.1);
  assert.equal(state_of(model.moment(null))!.state, "CALIBRATION_DRIVE");
  model.take(pose(1.3, "CONVERGING", null), 1.3);
  assert.equal(state_of(model.moment(null))!.state, "CONVERGING");
});

test("links that are not open and findings are notices", () => {
  const model = new Model();
  model.take(
    status("TRACKING", {
      links: [{ link: "ports/tag-1", open: false, error: "the device is gone" }, { link: "ports/tag-2", open: true }],
      robot: { link: "robot.sock", open: false, error: null },
      diagnosis: [{ cause: "odometry-scale", evidence: "2 % longer", remedy: "multiply" }],
    }),
    1,
  );
  const notices = notices_of(model.moment(null));
  assert.deepEqual(notices.map((notice) => notice.title), ["No link to the node", "No link to the robot", "odometry scale"]);
  assert.equal(notices[0]!.text, "ports/tag-1: the device is gone.");
  assert.equal(notices[2]!.remedy, "Multiply.");
});

test("an anchor that was moved is a notice", () => {
  const model = new Model();
  model.take(status("TRACKING", { anchors: [{ id: 4, verdict: "ok" }, { id: 5, verdict: "moved" }] }), 1);
  const [notice, ...others] = notices_of(model.moment(null));
  assert.equal(notice!.title, "Anchor 5 moved");
  assert.deepEqual(others, []);
});

test("while anchors are calibrated, the least covered one says where to drive", () => {
  const model = new Model();
  const anchors = [{ id: 4, coverage: 1 }, { id: 5, coverage: 0.7, advice: "pass there" }, { id: 6, coverage: 0.2, advice: "turn here" }];
  model.take({ class: "CALIBRATION", anchors }, 1);
  const [notice] = notices_of(model.moment(null));
  assert.equal(notice!.text, "1 of 3 anchors are covered.");
  assert.equal(notice!.remedy, "Next, for anchor 6: turn here.");
  model.take({ class: "CALIBRATION", anchors: [{ id: 4, coverage: 1 }] }, 2);
  assert.deepEqual(notices_of(model.moment(null)), []);
});
