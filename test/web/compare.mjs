// Compares what the page's model has with the lines of the pose stream of the same gromad.
import assert from "node:assert/strict";

// What the page has, as plain data. It runs in the browser, too, and therefore uses nothing of this module.
export function snapshot(model) {
  const plain = (of) => (of === null ? null : JSON.parse(JSON.stringify(of)));
  const poses = [];
  for (let i = model.poses.first(); i < model.poses.end(); i++) poses.push(plain(model.poses.get(i)));
  return {
    pose: plain(model.pose),
    poses,
    statuses: model.statuses.items.map((status) => ({ ...plain(status), pairs: Array.from(status.pairs) })),
    calibration: plain(model.calibration),
    anchor_set: plain(model.anchor_set),
    logs: model.logs.items.map((line) => line.text),
    site: plain(model.site),
    counts: { ...model.counts },
  };
}

// Unknown numbers are NaN in the model, and null in both.
const known = (value) => (value === undefined || Number.isNaN(value) ? null : value);

export function compare_poses(page, stream) {
  let compared = 0;
  for (const pose of [...page.poses, page.pose]) {
    if (!pose || pose.t_s < stream.first_s) continue; // older than the connection to the pose stream
    const line = stream.poses.get(pose.t_s);
    assert.ok(line, `the pose at ${pose.t_s} s is not in the pose stream`);
    const { t_s, state, reason, x_m, y_m, z_m, yaw_rad, xx_m2, xy_m2, yy_m2, yaw_rad2, vx_mps, vy_mps, omega_radps } = pose;
    assert.deepEqual(
      { t_s, state, reason, x_m, y_m, z_m, yaw_rad, xx_m2, xy_m2, yy_m2, yaw_rad2, vx_mps, vy_mps, omega_radps },
      {
        t_s: line.t_s, state: line.state, reason: line.reason ?? "", x_m: line.x_m, y_m: line.y_m, z_m: line.z_m, yaw_rad: line.yaw_rad,
        xx_m2: line.covariance[0], xy_m2: line.covariance[1], yy_m2: line.covariance[7], yaw_rad2: line.covariance[35],
        vx_mps: line.twist.vx_mps, vy_mps: line.twist.vy_mps, omega_radps: line.twist.omega_radps,
      },
    );
    compared++;
  }
  return compared;
}

const kPairNumbers = ["tag", "anchor", "ranges", "used", "gated", "range_m", "innovation_m"];

export function compare_statuses(page, stream) {
  let compared = 0;
  for (const status of page.statuses) {
    const line = stream.statuses.get(status.t_s);
    if (!line) continue; // older than the connection
    const finding = ({ cause, evidence, remedy }) => ({ cause, evidence, remedy });
    const numbers = ["odometry", "ranges", "frames_lost", "dropped", "driven_m", "turned_rad"];
    for (const name of numbers) assert.equal(status[name], known(line[name]), `${name} at ${status.t_s} s`);
    assert.equal(status.state, line.state, `state at ${status.t_s} s`);
    assert.deepEqual(status.diagnosis.map(finding), line.diagnosis.map(finding));
    assert.deepEqual(status.anchors, line.anchors.map(({ id, verdict }) => ({ id, verdict })));
    assert.deepEqual(status.links.map(({ link, open, error, ranges }) => ({ link, open, error, ranges })), line.links.map(({ link, open, error, ranges }) => ({ link, open, error, ranges })));
    const pairs = [];
    for (let i = 0; i < status.pairs.length; i += kPairNumbers.length + 1) pairs.push(status.pairs.slice(i, i + kPairNumbers.length).map(known));
    assert.deepEqual(pairs, line.pairs.map((pair) => kPairNumbers.map((name) => known(pair[name]))));
    compared++;
  }
  return compared;
}

// It has no time: it is one of the lines, and a recent one.
export function compare_calibration(page, stream) {
  const lines = stream.calibrations.slice(-4).map((line) =>
    line.anchors.map(({ id, state, coverage, verdict, advice, ranges_used, sigma_m, drive_to_m }) => ({ id, state, coverage, verdict, advice, ranges_used, sigma_m, drive_to_m })),
  );
  assert.ok(page.calibration && lines.length > 0, "no calibration");
  const shown = JSON.stringify(page.calibration.anchors);
  assert.ok(lines.some((line) => JSON.stringify(line) === shown), `${shown}\nis none of the last lines; the last is\n${JSON.stringify(lines.at(-1))}`);
  return page.calibration.anchors.length;
}

// Those in use have the positions and verdicts of the file that gromad wrote.
export function compare_anchors(page, calibration) {
  const placed = (page.anchor_set?.anchors ?? []).filter((anchor) => anchor.position_m !== null);
  assert.ok(placed.length > 0, "no anchor has a position");
  for (const { id, position_m, verdict } of placed) {
    const written = calibration.get(id);
    assert.equal(verdict, written?.verdict, `verdict of anchor ${id}`);
    position_m.forEach((value, axis) => assert.ok(Math.abs(value - written.position_m[axis]) < 1e-9, `anchor ${id} is at ${position_m}, not ${written.position_m}`));
  }
  return placed.length;
}
