// A synthetic site with the messages of /live: a hall with twelve anchors, and a robot with three tags that drives a loop.
const kAnchors = [
  [4, 2.5, 1.8, 2.8], [5, 3.4, 12.9, 3.1], [6, 9.6, 2.3, 3.2], [7, 16.0, 13.0, 3.1], [8, 16.6, 6.0, 0.5], [9, 16.6, 6.0, 2.1],
  [10, 20.2, 6.0, 0.4], [11, 19.7, 6.4, 2.4], [12, 21.9, 6.2, 0.6], [13, 21.3, 6.5, 2.7], [14, 21.7, 10.6, 2.9], [15, 21.1, 10.0, 0.6],
].map(([id, ...position_m]) => ({ id, position_m }));
const kTags = [[1, 0.75, 0.45, 1.9], [2, -0.7, -0.42, 1.25], [3, 0.6, -0.45, 0.35]].map(([id, ...lever_arm_m]) => ({ id, lever_arm_m }));
const kWay = [[2.5, 7.5], [2.5, 3.4], [8, 3.4], [13.2, 3.4], [18.6, 3.6], [18.6, 8.3], [25.6, 10], [31.6, 9.6], [32, 4.2], [26, 3.6], [24, 8.3], [18.4, 9], [18.4, 11], [13.5, 11], [8, 11.8], [2.6, 11.6]];
const chain = (...points) => points.slice(1).map((to, i) => [...points[i], ...to]);
const kWalls = [
  ...chain([20.75, 6.75], [20.75, 0.5], [-3.25, 0.5], [-3.25, 14.5], [20.75, 14.5], [20.75, 9.85]),
  ...chain([-3.25, 5], [0.8, 5], [0.8, 0.5]),
  ...chain([6, 5.2], [11, 5.2]),
  ...chain([6.5, 9.8], [11.5, 9.8]),
  ...chain([14.2, 12.4], [15, 12.4], [15, 13.2], [14.2, 13.2], [14.2, 12.4]),
  ...chain([26.5, 12.2], [29.5, 12.2]),
];
const kSpeed_mps = 0.9;

const legs = kWay.map((from, i) => {
  const to = kWay[(i + 1) % kWay.length];
  return { from, to, length_m: Math.hypot(to[0] - from[0], to[1] - from[1]) };
});
const around_m = legs.reduce((sum, leg) => sum + leg.length_m, 0);

function way(t_s) {
  let left_m = (t_s * kSpeed_mps) % around_m;
  for (const { from, to, length_m } of legs) {
    if (left_m <= length_m) {
      const share = left_m / length_m;
      const yaw_rad = Math.atan2(to[1] - from[1], to[0] - from[0]);
      return { x_m: from[0] + share * (to[0] - from[0]), y_m: from[1] + share * (to[1] - from[1]), yaw_rad };
    }
    left_m -= length_m;
  }
  return { x_m: kWay[0][0], y_m: kWay[0][1], yaw_rad: 0 };
}

// A wave that looks random but is the same in each run.
const noise = (t_s, seed) => Math.sin(1.7 * t_s + 12.9 * seed) * Math.sin(0.31 * t_s + 78.2 * seed);

const kStatusOnly = ["UNINITIALIZED", "CALIBRATION_DRIVE", "CALIBRATING", "WAITING_FOR_ODOMETRY", "ODOMETRY_TIMES_WRONG"];

export class Site {
  // state: as in a pose, with a reason after a colon (DEGRADED:tag-silent); "tour" changes it as a real drive would;
  // "LEARNING" tracks while anchors are calibrated.
  constructor({ state = "tour" } = {}) {
    [this.state, this.reason = null] = state.split(":");
    this.learns = ["tour", "LEARNING"].includes(this.state);
  }

  at(t_s) {
    if (this.state === "LEARNING") return { state: "TRACKING", reason: null };
    if (this.state !== "tour") return { state: this.state, reason: this.reason };
    const phase_s = t_s % 240;
    if (phase_s < 4) return { state: "CONVERGING", reason: null };
    if (phase_s > 120 && phase_s < 132) return { state: "DEGRADED", reason: "tag-silent" };
    if (phase_s > 200 && phase_s < 206) return { state: "DEGRADED", reason: "ranges-disagree" };
    if (phase_s > 206 && phase_s < 211) return { state: "LOST", reason: null };
    if (phase_s >= 211 && phase_s < 215) return { state: "CONVERGING", reason: null };
    return { state: "TRACKING", reason: null };
  }

  version() {
    return { class: "VERSION", program: "gromad", version: "0.2.0", protocol: 1 };
  }

  site() {
    return {
      class: "SITE", frame: "Hall 3", model: "schmidt", simulated: true, learns: this.learns, tags: kTags, nodes: kTags.map((tag) => `ports/tag-${tag.id}`), walls: kWalls,
      floors: [{ name: null, outline_m: [[-5, -1], [36, -1], [36, 17], [-5, 17]] }],
    };
  }

  coverage(id, t_s) {
    const needs_s = 60 + 15 * ((id * 7) % 12);
    return this.learns ? Math.min(1, (t_s % 240) / needs_s) : 1;
  }

  verdict(id, t_s) {
    const coverage = this.coverage(id, t_s);
    if (coverage < 1) return coverage < 0.1 ? "no-data" : coverage < 0.6 ? "weak" : "weak-z";
    return { 10: "weak-z", 12: this.state === "DEGRADED" ? "moved" : "ok", 15: this.state === "DEGRADED" ? "never-in-sight" : "ok" }[id] ?? "ok";
  }

  advice(id, t_s) {
    const [x_m, y_m] = kAnchors.find((anchor) => anchor.id === id).position_m;
    if (this.verdict(id, t_s) === "ok") return "";
    if (this.verdict(id, t_s) === "moved") return "was moved during the drive, about t_s = 214, by 0.8 m to its +x side: check that it is fixed, and drive again";
    return `pass within 3.0 m of (${x_m.toFixed(1)}, ${y_m.toFixed(1)}), on its +x side, and turn there`;
  }

  anchors(t_s) {
    const anchors = kAnchors.map(({ id, position_m }) => {
      const s = 0.012 + 0.25 * (1 - this.coverage(id, t_s)) + (id === 10 ? 0.15 : 0);
      const covariance_m2 = [s * s, 0.4 * s * s, 0, 0.4 * s * s, 0.6 * s * s, 0, 0, 0, 4 * s * s];
      return { id, position_m, covariance_m2, verdict: this.verdict(id, t_s), advice: this.advice(id, t_s) };
    });
    return { class: "ANCHORS", t_s, verdict: "warnings", anchors };
  }

  calibration(t_s) {
    const anchors = kAnchors.map(({ id, position_m: [x_m, y_m] }) => {
      const coverage = this.coverage(id, t_s);
      return {
        id, state: coverage < 1 ? "learning" : "live", coverage, verdict: this.verdict(id, t_s), advice: this.advice(id, t_s), ranges_used: Math.round(2200 * coverage),
        sigma_m: coverage < 0.1 ? null : 0.012 + 0.3 * (1 - coverage), drive_to_m: coverage < 1 ? [x_m + 2.2 * Math.cos(id), y_m + 2.2 * Math.sin(id)] : null,
      };
    });
    return { class: "CALIBRATION", verdict: "warnings", anchors };
  }

  // null: there is no pose in this state.
  pose(t_s) {
    const { state, reason } = this.at(t_s);
    if (kStatusOnly.includes(state)) return null;
    const { x_m, y_m, yaw_rad } = way(t_s);
    const s = { TRACKING: 0.014, CONVERGING: 0.3, DEGRADED: 0.12, LOST: 1.4 }[state] ?? 0.02;
    const sigma_m = s * (1 + 0.3 * noise(t_s, 1));
    const covariance = new Array(36).fill(0);
    covariance[0] = sigma_m ** 2;
    covariance[1] = covariance[6] = 0.4 * sigma_m ** 2;
    covariance[7] = 0.5 * sigma_m ** 2;
    covariance[35] = 0.003 ** 2;
    return {
      class: "POSE", t_s, frame: "map", model: "schmidt", state, reason,
      x_m: x_m + sigma_m * noise(t_s, 2), y_m: y_m + sigma_m * noise(t_s, 3), z_m: 0, roll_rad: 0, pitch_rad: 0, yaw_rad, covariance,
      quaternion: [0, 0, Math.sin(yaw_rad / 2), Math.cos(yaw_rad / 2)], child_frame: "base_link",
      twist: { vx_mps: kSpeed_mps, vy_mps: 0, omega_radps: 0, covariance: new Array(36).fill(null) },
    };
  }

  diagnosis(state, reason) {
    if (reason === "map-mismatch") {
      return [{ cause: "map-mismatch", evidence: "91 % of the ranges of the last 15 s contradict the calibration at every pose", remedy: "name the calibration of this site, or calibrate again" }];
    }
    if (state === "ODOMETRY_TIMES_WRONG") {
      return [{ cause: "time-unit", evidence: "t_s runs 1000 times as fast as this computer's clock", remedy: "send t_s in seconds, not in milliseconds", value: 1000, sigma: null }];
    }
    if (state === "DEGRADED") {
      return [
        { cause: "odometry-scale", evidence: "the path by odometry is 2.1 % (sigma 0.3 %) longer than that by ranges, over 84 m", remedy: "multiply vx_mps and vy_mps by 0.979", value: 0.979, sigma: 0.003 },
        { cause: "lever-arm", evidence: "tag 2 is 0.21 m (sigma 0.03 m) from where the configuration has it", remedy: "measure lever_arm_m of tag 2 again", value: 0.21, sigma: 0.03, of: "tag 2" },
      ];
    }
    return [];
  }

  status(t_s) {
    const { state, reason } = this.at(t_s);
    const { x_m, y_m } = way(t_s);
    const has_ranges = reason !== "no-ranges";
    const pairs = kTags.flatMap((tag) =>
      kAnchors.map(({ id, position_m }) => {
        const far_m = Math.hypot(position_m[0] - x_m, position_m[1] - y_m, position_m[2] - tag.lever_arm_m[2]);
        const is_hidden = (x_m > 20.75) !== (position_m[0] > 20.75) && far_m > 9;
        const share = is_hidden ? 0.75 : (id * tag.id) % 11 === 0 ? 0.3 : 0.02;
        const ranges = Math.round(42 * t_s);
        return { tag: tag.id, anchor: id, ranges, used: Math.round(ranges * (1 - share)), gated: Math.round(ranges * share), range_m: far_m, innovation_m: is_hidden ? 1.6 : 0.02 + 0.08 * share };
      }),
    );
    const silent = reason === "tag-silent" ? 3 : 0;
    const links = kTags.map(({ id }) => ({
      link: `/dev/serial/by-id/usb-SEGGER_J-Link_00076012345${id}-if00`, open: id !== silent, error: id === silent ? "the device is gone (No such device)" : null, round_trip_s: 0.0011 + 0.0001 * id,
      frames: Math.round(48 * t_s), frames_dropped: id === 2 ? 3 : 0, bytes_discarded: 0, ranges: Math.round(480 * t_s),
      node: {
        id, role: "tag", network_id: 18258, version: "0.2.0", sync: id === silent ? "searching" : "locked",
        network: id === silent ? null : { master: 11, slot: id - 1, slots: 4, superframe_s: 0.02304, candidates: 12, answering: 11, hop: 1, beacons_missed: id },
      },
    }));
    const has_odometry = state !== "WAITING_FOR_ODOMETRY" && reason !== "no-odometry";
    return {
      class: "STATUS", state, odometry: has_odometry ? Math.round(50 * t_s) : 4000, ranges: has_ranges ? Math.round(1440 * t_s + 900 * Math.sin(t_s / 7)) : 500000, frames_lost: 2, dropped: Math.round(28 * t_s),
      links, robot: { link: "robot.sock", open: has_odometry, error: has_odometry ? null : "connection refused" }, diagnosis: this.diagnosis(state, reason),
      t_s: state === "WAITING_FOR_ODOMETRY" ? null : t_s, driven_m: kSpeed_mps * t_s, turned_rad: 0.1 * t_s, pose_latency_s: { p50: 0.0002, p99: 0.0005 },
      anchors: kAnchors.map(({ id }) => ({ id, verdict: this.verdict(id, t_s) })), pairs: has_ranges ? pairs.filter((pair) => pair.tag !== silent) : [],
    };
  }

  // As gromad keeps it.
  history(from_s, to_s) {
    const out = [];
    let before = "";
    for (let tick = Math.ceil(20 * from_s); tick < 20 * to_s; tick++) {
      const t_s = tick / 20;
      if (tick % 1200 === 0 || out.length === 0) out.push(this.anchors(t_s));
      const { state, reason } = this.at(t_s);
      const now = `${state} ${reason}`;
      const pose = now !== before || tick % 5 === 0 ? this.pose(t_s) : null;
      if (pose) out.push(pose);
      if (tick % 40 === 0) out.push(this.status(t_s));
      if (tick % 20 === 0 && this.learns) out.push(this.calibration(t_s));
      if (now !== before) out.push({ class: "LOG", t_s, text: `state ${state}${reason ? `, ${reason}` : ""}` });
      before = now;
    }
    return out;
  }
}
