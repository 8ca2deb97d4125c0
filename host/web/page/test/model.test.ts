import assert from "node:assert/strict";
import test from "node:test";
import type { Message } from "../src/messages";
import { anchors_of, Model, pairs_of } from "../src/model";

const pose = (t_s: number, more: object = {}): Message => ({ class: "POSE", t_s, state: "TRACKING", reason: null, x_m: t_s, y_m: 0, yaw_rad: 0, covariance: [], ...more });
const status = (t_s: number | null, more: object = {}): Message => ({ class: "STATUS", state: "TRACKING", t_s, ...more });

test("a pose is read as it is", () => {
  const model = new Model();
  const covariance = Array.from({ length: 36 }, (_, i) => i);
  model.take(pose(7.5, { y_m: 2, yaw_rad: 0.5, covariance, floor: "upper", twist: { vx_mps: 0.8, vy_mps: 0.1, omega_radps: -0.2 } }), 0);
  const { at_s, ...read } = model.pose!;
  assert.ok(Number.isFinite(at_s));
  assert.deepEqual(read, {
    t_s: 7.5, state: "TRACKING", reason: "", floor: "upper", x_m: 7.5, y_m: 2, z_m: NaN, yaw_rad: 0.5,
    xx_m2: 0, xy_m2: 1, yy_m2: 7, yaw_rad2: 35, vx_mps: 0.8, vy_mps: 0.1, omega_radps: -0.2,
  });
  assert.deepEqual(model.poses.get(model.poses.end() - 1), model.pose);
});

test("poses of 20 Hz are kept five times a second, and where the state changes", () => {
  const model = new Model();
  for (let i = 0; i < 200; i++) model.take(pose(i / 20, { state: i === 51 ? "LOST" : "TRACKING" }), i / 20);
  assert.equal(model.pose!.t_s, 199 / 20);
  const kept = model.poses.end() - model.poses.first();
  assert.ok(kept >= 50 && kept <= 53, String(kept));
  const states = Array.from({ length: kept }, (_, i) => model.poses.state(model.poses.first() + i));
  assert.equal(states.filter((state) => state === "LOST").length, 1);
});

test("45 minutes leave ten in memory", () => {
  const model = new Model();
  for (let i = 0; i < 45 * 60 * 20; i++) {
    const t_s = i / 20;
    model.take(pose(t_s, { state: i % 3000 === 0 ? "LOST" : "TRACKING" }), t_s);
    if (i % 20 === 0) {
      model.take(status(t_s, { pairs: [{ tag: 1, anchor: 4, ranges: i, used: i, gated: 0 }] }), t_s);
      model.take({ class: "CALIBRATION", anchors: [{ id: 4, coverage: 0.5, advice: `at ${i}` }] }, t_s);
      model.take({ class: "LOG", t_s, text: `line ${i}` }, t_s);
    }
  }
  assert.ok(model.newest_at_s() - model.oldest_at_s() <= 600);
  assert.ok(model.poses.end() - model.poses.first() <= 3010);
  assert.ok(model.statuses.items.length <= 310, String(model.statuses.items.length));
  assert.ok(model.calibrations.items.length <= 125, String(model.calibrations.items.length));
  assert.ok(model.logs.items.length <= 300);
});

test("the memory of 45 minutes is bounded", () => {
  // Parsed from text, as a browser gets it: 3 tags and 12 anchors, whose texts change all the time.
  const text = (t_s: number) => {
    const pairs = Array.from({ length: 36 }, (_, i) => ({ tag: i % 3, anchor: i % 12, ranges: t_s * 40, used: t_s * 38, gated: t_s, range_m: 5 + t_s / 7, innovation_m: 0.01 }));
    const links = [1, 2, 3].map((id) => ({ link: `ports/tag-${id}`, open: true, frames: t_s * 50, ranges: t_s * 480, node: { id, role: "tag", version: "0.2.0", network: { slot: id, slots: 4 } } }));
    return JSON.stringify({ ...status(t_s), pairs, links, diagnosis: [{ cause: "lever-arm", evidence: `tag 2 is ${t_s} m off`, remedy: "measure it" }] });
  };
  const anchors = (t_s: number) => Array.from({ length: 12 }, (_, id) => ({ id, coverage: 0.5, advice: `pass within ${t_s} m` }));
  const bytes = () => {
    for (let i = 0; i < 4; i++) (globalThis as unknown as { gc: () => void }).gc();
    const { heapUsed, external } = process.memoryUsage();
    return heapUsed + external;
  };
  const model = new Model();
  const drive = (from_s: number, to_s: number) => {
    for (let t_s = from_s; t_s < to_s; t_s++) {
      for (let i = 0; i < 20; i++) model.take(JSON.parse(JSON.stringify(pose(t_s + i / 20))), t_s + i / 20);
      model.take(JSON.parse(text(t_s)), t_s + 0.99);
      model.take(JSON.parse(JSON.stringify({ class: "CALIBRATION", anchors: anchors(t_s) })), t_s + 0.99);
    }
  };
  drive(0, 10);
  const begin = bytes();
  drive(10, 45 * 60);
  const grown_mib = (bytes() - begin) / 2 ** 20;
  assert.ok(grown_mib < 5, `${grown_mib} MiB`);
  assert.ok(model.pose !== null);
});

test("the history comes before what is live, on one axis", () => {
  const model = new Model();
  model.take({ class: "HISTORY", state: "begin", messages: 3 }, 100);
  model.take(status(null, { state: "WAITING_FOR_ODOMETRY" }), 100);
  model.take(status(null, { state: "WAITING_FOR_ODOMETRY" }), 100);
  for (let i = 0; i < 40; i++) model.take(pose(500 + i / 4), 100);
  assert.equal(model.history, "loading");
  assert.equal(model.history_taken, 42);
  model.take({ class: "HISTORY", state: "end" }, 101);
  assert.equal(model.history, "complete");
  const newest_s = model.newest_at_s();
  assert.equal(newest_s - model.oldest_at_s(), 2 + 9.75);
  model.take(pose(510), 101.25);
  assert.ok(Math.abs(model.newest_at_s() - newest_s - 0.25) < 1e-9);
  assert.ok(Math.abs(model.axis_at_s(103.25) - model.newest_at_s() - 2) < 1e-9);
});

test("a clock that was set does not tear the history apart", () => {
  const model = new Model();
  model.take({ class: "HISTORY", state: "begin", messages: 80 }, 0);
  for (let i = 0; i < 40; i++) model.take(pose(1000 + i / 4), 0);
  for (let i = 0; i < 40; i++) model.take(pose(20 + i / 4), 0);
  const span_s = model.newest_at_s() - model.oldest_at_s();
  assert.ok(span_s > 19 && span_s < 20.5, String(span_s));
});

test("another connection replaces the history", () => {
  const model = new Model();
  for (const arrived_s of [10, 50]) {
    model.take({ class: "HISTORY", state: "begin", messages: 4 }, arrived_s);
    for (let i = 0; i < 4; i++) model.take(pose(100 + i), arrived_s);
    model.take({ class: "HISTORY", state: "end" }, arrived_s);
    assert.equal(model.poses.end() - model.poses.first(), 4);
  }
});

test("anchors that come before the history hold in it, and end with the connection", () => {
  const model = new Model();
  const anchors = (id: number): Message => ({ class: "ANCHORS", t_s: 700, anchors: [{ id, position_m: [1, 2, 3] }] });
  const ids = (at_s: number | null) => anchors_of(model.moment(at_s)).map((anchor) => anchor.id);
  model.take({ class: "VERSION" }, 0);
  model.take(anchors(4), 0);
  model.take({ class: "HISTORY", state: "begin", messages: 4 }, 0);
  for (let i = 0; i < 3; i++) model.take(pose(100 + i), 0);
  assert.deepEqual(ids(null), [4]);
  assert.deepEqual(ids(model.oldest_at_s()), [4]);
  assert.equal(model.newest_at_s() - model.oldest_at_s(), 2);
  model.take({ ...anchors(5), t_s: 102 } as Message, 0);
  model.take({ class: "HISTORY", state: "end" }, 0);
  assert.deepEqual(ids(null), [5]);
  assert.deepEqual(ids(model.oldest_at_s()), [4]);
  model.take({ class: "VERSION" }, 9);
  model.take({ class: "HISTORY", state: "begin", messages: 0 }, 9);
  model.take({ class: "HISTORY", state: "end" }, 9);
  assert.deepEqual(ids(null), []);
});

test("a moment of the past has what was there then", () => {
  const model = new Model();
  for (let i = 0; i <= 100; i++) {
    model.take(pose(i), i);
    model.take(status(i, { ranges: 10 * i, state: i < 50 ? "CONVERGING" : "TRACKING" }), i);
  }
  const begin_s = model.oldest_at_s();
  const moment = model.moment(begin_s + 40.5);
  assert.equal(moment.is_latest, false);
  assert.equal(moment.pose!.t_s, 40);
  assert.equal(moment.status!.state, "CONVERGING");
  assert.equal(model.moment(null).status!.ranges, 1000);
});

test("rates are differences of the counters by the robot's clock", () => {
  const model = new Model();
  model.take(status(10, { ranges: 1000, odometry: 500, links: [{ link: "a", open: true, ranges: 10 }] }), 1);
  model.take(status(12, { ranges: 4000, odometry: 600, links: [{ link: "a", open: true, ranges: 30 }] }), 2.9);
  assert.equal(model.status!.ranges_hz, 1500);
  assert.equal(model.status!.odometry_hz, 50);
  assert.equal(model.status!.links[0]!.ranges_hz, 10);
  model.take(status(13, { ranges: 5 }), 3.9);
  assert.ok(Number.isNaN(model.status!.ranges_hz), "gromad began again");
});

test("the gated share of a pair is that of the last seconds", () => {
  const model = new Model();
  for (let i = 0; i <= 20; i++) {
    const pairs = [{ tag: 1, anchor: 4, ranges: 100 * i, used: 100 * Math.min(i, 10), gated: 100 * Math.max(0, i - 10), range_m: 3, innovation_m: null }];
    model.take(status(i, { pairs }), i);
  }
  const [pair] = pairs_of(model.status);
  assert.equal(pair!.gated_share, 1);
  assert.equal(pair!.range_m, 3);
  assert.ok(Number.isNaN(pair!.innovation_m));
});

test("an anchor joins what all messages have of it", () => {
  const model = new Model();
  model.take(status(1, { anchors: [{ id: 7, verdict: "ok" }] }), 1);
  model.take({ class: "ANCHORS", t_s: 1, anchors: [{ id: 4, position_m: [1, 2, 3], covariance_m2: [0.04, 0, 0, 0, 0.01, 0, 0, 0, 1], verdict: "weak", advice: "" }] }, 1);
  model.take({ class: "CALIBRATION", anchors: [{ id: 4, state: "learning", coverage: 0.4, verdict: "weak-z", advice: "turn there", sigma_m: null, drive_to_m: [5, 6] }] }, 1);
  const [four, seven] = anchors_of(model.moment(null));
  assert.equal(four!.verdict, "weak-z");
  assert.equal(four!.sigma_m, 0.2);
  assert.deepEqual(four!.position_m, [1, 2, 3]);
  assert.deepEqual(four!.drive_to_m, [5, 6]);
  assert.equal(seven!.verdict, "ok");
  assert.equal(seven!.position_m, null);
});

test("what is absent, null or unknown does no harm", () => {
  const model = new Model();
  const odd: unknown[] = [null, 5, "text", {}, { class: "NEW" }, { class: "POSE" }, { class: "POSE", t_s: 1, x_m: null, y_m: 0, yaw_rad: 0 }, { class: "STATUS" }, { class: "SITE" },
    { class: "ANCHORS", anchors: [{ id: 1, position_m: null }] }, { class: "CALIBRATION" }, { class: "LOG" }, { class: "STATUS", links: [{}], pairs: null, robot: null }];
  for (const message of odd) model.take(message as Message, 1);
  assert.equal(model.pose, null);
  assert.equal(model.status!.links[0]!.network, null);
  assert.deepEqual(model.site!.walls, []);
});
