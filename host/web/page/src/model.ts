// What the page knows: messages in, state out. No DOM, so that tests run it without a browser.
//
// The time axis (at_s) serves the time line. It never goes back, while t_s, the robot's clock, may be set at any time, and
// is unknown before odometry. Messages of the history have no time of arrival: they are placed by their t_s. Those that
// follow are placed by the time at which they arrived.
import { History, PoseHistory, type Pose } from "./history";
import type {
  AnchorsMessage,
  CalibrationMessage,
  LinkMessage,
  LogMessage,
  Message,
  NetworkMessage,
  Optional,
  PairMessage,
  PoseMessage,
  SiteMessage,
  StatusMessage,
} from "./messages";
import { gated_share, rate } from "./quality";

export interface Site {
  frame: string;
  model: string;
  simulated: boolean;
  learns: boolean;
  tags: { id: number; lever_arm_m: number[] }[];
  nodes: string[];
  walls: number[][];
  floors: { name: string | null; outline_m: number[][] | null }[];
}

export interface Link {
  link: string;
  open: boolean;
  error: string | null;
  round_trip_s: number;
  frames: number;
  frames_dropped: number;
  bytes_discarded: number;
  ranges: number;
  frames_hz: number;
  ranges_hz: number;
  id: number | null;
  role: string | null;
  version: string | null;
  sync: string | null;
  radio_error: string | null;
  network: NetworkMessage | null;
}

export interface Pair {
  tag: number;
  anchor: number;
  ranges: number;
  used: number;
  gated: number;
  range_m: number;
  innovation_m: number;
  gated_share: number; // of the last seconds; NaN: no range was judged
}

export interface Finding {
  cause: string;
  evidence: string;
  remedy: string;
}

export interface Status {
  at_s: number;
  t_s: number;
  state: string;
  odometry: number;
  ranges: number;
  frames_lost: number;
  dropped: number;
  driven_m: number;
  turned_rad: number;
  latency_p50_s: number;
  latency_p99_s: number;
  odometry_hz: number;
  ranges_hz: number;
  lost_hz: number;
  dropped_hz: number;
  links: Link[];
  robots: Link[];
  anchors: { id: number; verdict: string }[];
  pairs: Float64Array; // kPairNumbers of each, see pairs_of
  diagnosis: Finding[];
}

export interface Calibration {
  at_s: number;
  verdict: string;
  anchors: {
    id: number;
    state: string;
    coverage: number;
    verdict: string;
    advice: string;
    ranges_used: number;
    sigma_m: number;
    drive_to_m: [number, number] | null;
  }[];
}

export interface AnchorSet {
  at_s: number;
  verdict: string;
  anchors: { id: number; position_m: number[] | null; covariance_m2: number[] | null; verdict: string; advice: string }[];
}

export interface LogLine {
  at_s: number;
  t_s: number;
  text: string;
}

// All that is known of one anchor at a moment.
export interface Anchor {
  id: number;
  verdict: string;
  advice: string;
  state: string; // while calibrating: known, learning, live, moved
  coverage: number; // NaN: not reported
  ranges_used: number;
  sigma_m: number;
  drive_to_m: [number, number] | null;
  position_m: number[] | null;
  covariance_m2: number[] | null;
}

export interface Moment {
  at_s: number;
  is_latest: boolean;
  pose: Pose | null;
  status: Status | null;
  calibration: Calibration | null;
  anchor_set: AnchorSet | null;
}

export interface Limits {
  horizon_s: number; // how far back the memory reaches
  poses: number;
  pose_interval_s: number;
  statuses: number;
}

const kLive: Limits = { horizon_s: 600, poses: 4096, pose_interval_s: 0.2, statuses: 400 };
const kStatusInterval_s = 1.9;
const kCalibrationInterval_s = 4.9;
const kMaxLogLines = 300;
const kMaxText = 600;
// A step of t_s in the history that is longer is one of the robot's clock: STATUS comes each 2 s.
const kClockStep_s = 30;
// Shares of gated ranges are those of at least this long, so that a few ranges do not decide.
const kShareWindow_s = 5;

const kPairNumbers = ["tag", "anchor", "ranges", "used", "gated", "range_m", "innovation_m", "gated_share"] as const;

export function pairs_of(status: Status | null): Pair[] {
  const out: Pair[] = [];
  if (status === null) return out;
  for (let i = 0; i < status.pairs.length; i += kPairNumbers.length) {
    const pair = {} as Pair;
    kPairNumbers.forEach((name, column) => (pair[name] = status.pairs[i + column]!));
    out.push(pair);
  }
  return out;
}

const number = (value: unknown): number => (typeof value === "number" ? value : NaN);
const number_or_null = (value: unknown): number | null => (typeof value === "number" ? value : null);
const text = (value: unknown): string => (typeof value === "string" ? value.slice(0, kMaxText) : "");
const text_or_null = (value: unknown): string | null => (typeof value === "string" ? value.slice(0, kMaxText) : null);
const list = <T>(value: Optional<T[]>): T[] => (Array.isArray(value) ? value : []);
const point = (value: Optional<number[]>, length: number): number[] | null =>
  Array.isArray(value) && value.length >= length && value.every(Number.isFinite) ? value.slice(0, length) : null;

export class Model {
  version = "";
  site: Site | null = null;
  history: "none" | "loading" | "complete" = "none";
  history_messages = 0;
  history_taken = 0;
  counts: Record<string, number> = {}; // messages by class
  pose: Pose | null = null;
  status: Status | null = null;
  calibration: Calibration | null = null;
  anchor_set: AnchorSet | null = null;
  readonly poses: PoseHistory;
  readonly statuses: History<Status>;
  readonly calibrations = new History<Calibration>(200);
  readonly anchor_sets = new History<AnchorSet>(200);
  readonly logs = new History<LogLine>(kMaxLogLines);
  private offset_s = NaN; // at_s minus t_s, in the history
  private shift_s = NaN; // at_s minus the time of arrival
  private last_at_s = NaN;
  private texts = new Map<string, string>();

  constructor(readonly limits: Limits = kLive) {
    this.poses = new PoseHistory(limits.poses);
    this.statuses = new History(limits.statuses);
  }

  // now_s: when the message arrived, by any clock that does not go back.
  take(message: Message, now_s: number): void {
    if (typeof message !== "object" || message === null) return;
    this.counts[message.class] = (this.counts[message.class] ?? 0) + 1;
    if (this.history === "loading" && message.class !== "HISTORY") this.history_taken++;
    switch (message.class) {
      case "VERSION":
        this.version = [message.program, message.version].filter(Boolean).join(" ");
        this.anchor_set = null; // the first message of a connection
        break;
      case "SITE":
        this.site = site_of(message);
        break;
      case "HISTORY":
        if (message.state === "begin") this.begin_history(message.messages ?? 0);
        else this.end_history(now_s);
        break;
      case "POSE":
        this.take_pose(message, now_s);
        break;
      case "STATUS":
        this.take_status(message, now_s);
        break;
      case "CALIBRATION":
        this.take_calibration(message, now_s);
        break;
      case "ANCHORS":
        this.take_anchors(message, now_s);
        break;
      case "LOG":
        this.take_log(message, now_s);
        break;
    }
  }

  // The oldest and the newest time of the axis; NaN before the first message.
  newest_at_s(): number {
    return this.last_at_s;
  }

  oldest_at_s(): number {
    let oldest = this.last_at_s;
    if (this.poses.end() > this.poses.first()) oldest = Math.min(oldest, this.poses.number("at_s", this.poses.first()));
    const status = this.statuses.items[0];
    if (status) oldest = Math.min(oldest, status.at_s);
    return Math.max(oldest, this.last_at_s - this.limits.horizon_s);
  }

  // Where a time of arrival is on the axis.
  axis_at_s(now_s: number): number {
    return Number.isNaN(this.shift_s) ? this.last_at_s : Math.max(this.last_at_s, now_s + this.shift_s);
  }

  // null: the latest.
  moment(at_s: number | null): Moment {
    if (at_s === null) {
      return {
        at_s: this.last_at_s,
        is_latest: true,
        pose: this.pose,
        status: this.status,
        calibration: this.calibration,
        anchor_set: this.anchor_set,
      };
    }
    const end = this.poses.end_at(at_s);
    return {
      at_s,
      is_latest: false,
      pose: end > this.poses.first() ? this.poses.get(end - 1) : null,
      status: this.statuses.at(at_s),
      calibration: this.calibrations.at(at_s),
      // Before the first calibration of the memory, the anchors that it gave are still the best that the map has.
      anchor_set: this.anchor_sets.at(at_s) ?? this.anchor_sets.items[0] ?? null,
    };
  }

  // gromad sends its history again after each connection: it replaces what is there. Only the anchors in use came before
  // it, and hold until the history has others.
  private begin_history(messages: number): void {
    this.history = "loading";
    this.history_messages = messages;
    this.history_taken = 0;
    this.poses.clear();
    for (const each of [this.statuses, this.calibrations, this.anchor_sets, this.logs]) each.clear();
    this.pose = this.status = this.calibration = null;
    if (this.anchor_set) this.anchor_sets.push({ ...this.anchor_set, at_s: -Infinity });
    this.offset_s = this.shift_s = this.last_at_s = NaN;
    this.texts.clear();
  }

  private end_history(now_s: number): void {
    this.history = "complete";
    this.shift_s = Number.isNaN(this.last_at_s) ? NaN : this.last_at_s - now_s;
  }

  private place(t_s: number, now_s: number, step_s: number): number {
    const last = this.last_at_s;
    let at_s: number;
    if (this.history === "loading") {
      if (Number.isNaN(this.offset_s) && !Number.isNaN(t_s)) this.offset_s = Number.isNaN(last) ? 0 : last - t_s;
      at_s = Number.isNaN(t_s) ? (Number.isNaN(last) ? 0 : last + step_s) : t_s + this.offset_s;
      if (at_s > last + kClockStep_s || at_s < last - 1) {
        at_s = last + step_s;
        this.offset_s = at_s - t_s;
      }
    } else {
      if (Number.isNaN(this.shift_s)) this.shift_s = Number.isNaN(last) ? 0 : last - now_s;
      at_s = now_s + this.shift_s;
    }
    this.last_at_s = Number.isNaN(last) ? at_s : Math.max(last, at_s);
    return this.last_at_s;
  }

  private forget(): void {
    const oldest_s = this.last_at_s - this.limits.horizon_s;
    this.poses.drop_before(oldest_s);
    for (const each of [this.statuses, this.calibrations, this.anchor_sets, this.logs]) each.drop_before(oldest_s);
  }

  // One copy of a text that comes again and again.
  private shared(value: unknown): string {
    const of = text(value);
    const known = this.texts.get(of);
    if (known !== undefined) return known;
    if (this.texts.size > 1000) this.texts.clear();
    this.texts.set(of, of);
    return of;
  }

  private shared_or_null(value: unknown): string | null {
    return typeof value === "string" ? this.shared(value) : null;
  }

  private take_pose(message: PoseMessage, now_s: number): void {
    const { t_s, x_m, y_m, yaw_rad } = message;
    if (![t_s, x_m, y_m, yaw_rad].every(Number.isFinite)) return;
    const covariance = list(message.covariance);
    const pose: Pose = {
      at_s: this.place(t_s, now_s, this.limits.pose_interval_s),
      t_s,
      state: this.shared(message.state),
      reason: this.shared(message.reason),
      floor: this.shared(message.floor),
      x_m,
      y_m,
      z_m: number(message.z_m),
      yaw_rad,
      xx_m2: number(covariance[0]),
      xy_m2: number(covariance[1]),
      yy_m2: number(covariance[7]),
      yaw_rad2: number(covariance[35]),
      vx_mps: number(message.twist?.vx_mps),
      vy_mps: number(message.twist?.vy_mps),
      omega_radps: number(message.twist?.omega_radps),
    };
    const last = this.poses.end() > this.poses.first() ? this.poses.get(this.poses.end() - 1) : null;
    const is_due = last === null || pose.at_s - last.at_s >= this.limits.pose_interval_s - 1e-6;
    if (is_due || last.state !== pose.state || last.reason !== pose.reason) this.poses.push(pose);
    this.pose = pose;
    this.forget();
  }

  private take_status(message: StatusMessage, now_s: number): void {
    const t_s = number(message.t_s);
    const before = this.status;
    const at_s = this.place(t_s, now_s, 2);
    // The robot's clock measures best what lies between two messages; not where it was set.
    let elapsed_s = before ? t_s - before.t_s : NaN;
    const elapsed_on_axis_s = before ? at_s - before.at_s : NaN;
    if (!(elapsed_s > 0 && elapsed_s < kClockStep_s)) elapsed_s = elapsed_on_axis_s;
    const hz = (then: number | undefined, now: number) => (then === undefined ? NaN : rate(then, now, elapsed_s));

    const counted = {
      odometry: number(message.odometry),
      ranges: number(message.ranges),
      frames_lost: number(message.frames_lost),
      dropped: number(message.dropped),
    };
    const robots = message.robots ?? (message.robot ? [message.robot] : []);
    const status: Status = {
      at_s,
      t_s,
      state: this.shared(message.state),
      ...counted,
      driven_m: number(message.driven_m),
      turned_rad: number(message.turned_rad),
      latency_p50_s: number(message.pose_latency_s?.p50),
      latency_p99_s: number(message.pose_latency_s?.p99),
      odometry_hz: hz(before?.odometry, counted.odometry),
      ranges_hz: hz(before?.ranges, counted.ranges),
      lost_hz: hz(before?.frames_lost, counted.frames_lost),
      dropped_hz: hz(before?.dropped, counted.dropped),
      links: list(message.links).map((link) => {
        const now = this.link_of(link);
        const then = before?.links.find((of) => of.link === now.link);
        now.frames_hz = hz(then?.frames, now.frames);
        now.ranges_hz = hz(then?.ranges, now.ranges);
        return now;
      }),
      robots: robots.map((link) => this.link_of(link)),
      anchors: list(message.anchors).map(({ id, verdict }) => ({ id, verdict: this.shared(verdict) })),
      pairs: this.packed_pairs(list(message.pairs), at_s),
      diagnosis: list(message.diagnosis).map((finding) => ({
        cause: this.shared(finding.cause),
        evidence: this.shared(finding.evidence),
        remedy: this.shared(finding.remedy),
      })),
    };
    const last = this.statuses.last();
    const is_due = last === null || at_s - last.at_s >= kStatusInterval_s;
    if (is_due || last.state !== status.state || last.diagnosis.length !== status.diagnosis.length) this.statuses.push(status);
    this.status = status;
    this.forget();
  }

  private link_of(message: LinkMessage): Link {
    const node = message.node;
    return {
      link: this.shared(message.link),
      open: message.open === true,
      error: this.shared_or_null(message.error),
      round_trip_s: number(message.round_trip_s),
      frames: number(message.frames),
      frames_dropped: number(message.frames_dropped),
      bytes_discarded: number(message.bytes_discarded),
      ranges: number(message.ranges),
      frames_hz: NaN,
      ranges_hz: NaN,
      id: number_or_null(node?.id),
      role: this.shared_or_null(node?.role),
      version: this.shared_or_null(node?.version),
      sync: this.shared_or_null(node?.sync),
      radio_error: this.shared_or_null(node?.radio_error),
      network: node?.network ?? null,
    };
  }

  private packed_pairs(pairs: PairMessage[], at_s: number): Float64Array {
    const earlier = new Map<number, Pair>();
    for (const pair of pairs_of(this.statuses.at(at_s - kShareWindow_s))) earlier.set(pair.tag * 65536 + pair.anchor, pair);
    const out = new Float64Array(pairs.length * kPairNumbers.length);
    pairs.forEach((message, i) => {
      const used = number(message.used);
      const gated = number(message.gated);
      const before = earlier.get(message.tag * 65536 + message.anchor) ?? null;
      const share = gated_share(before, { used, gated });
      const values = [message.tag, message.anchor, number(message.ranges), used, gated, number(message.range_m), number(message.innovation_m), share];
      out.set(values, i * kPairNumbers.length);
    });
    return out;
  }

  private take_calibration(message: CalibrationMessage, now_s: number): void {
    const calibration: Calibration = {
      at_s: this.place(NaN, now_s, 0),
      verdict: this.shared(message.verdict),
      anchors: list(message.anchors).map((anchor) => ({
        id: anchor.id,
        state: this.shared(anchor.state),
        coverage: number(anchor.coverage),
        verdict: this.shared(anchor.verdict),
        advice: this.shared(anchor.advice),
        ranges_used: number(anchor.ranges_used),
        sigma_m: number(anchor.sigma_m),
        drive_to_m: point(anchor.drive_to_m, 2) as [number, number] | null,
      })),
    };
    const last = this.calibrations.last();
    if (last === null || calibration.at_s - last.at_s >= kCalibrationInterval_s) this.calibrations.push(calibration);
    this.calibration = calibration;
  }

  private take_anchors(message: AnchorsMessage, now_s: number): void {
    const set: AnchorSet = {
      at_s: this.place(number(message.t_s), now_s, 0),
      verdict: this.shared(message.verdict),
      anchors: list(message.anchors).map((anchor) => ({
        id: anchor.id,
        position_m: point(anchor.position_m, 3),
        covariance_m2: point(anchor.covariance_m2, 9),
        verdict: this.shared(anchor.verdict),
        advice: this.shared(anchor.advice),
      })),
    };
    this.anchor_sets.push(set);
    this.anchor_set = set;
  }

  private take_log(message: LogMessage, now_s: number): void {
    const t_s = number(message.t_s);
    this.logs.push({ at_s: this.place(t_s, now_s, 0), t_s, text: text(message.text) });
  }
}

function site_of(message: SiteMessage): Site {
  return {
    frame: text(message.frame),
    model: text(message.model),
    simulated: message.simulated === true,
    learns: message.learns === true,
    tags: list(message.tags).filter((tag) => Array.isArray(tag.lever_arm_m)),
    nodes: list(message.nodes).map(text),
    walls: list(message.walls).filter((wall) => wall.length >= 4 && wall.every(Number.isFinite)),
    floors: list(message.floors).map((floor) => ({ name: text_or_null(floor.name), outline_m: floor.outline_m ?? null })),
  };
}

// An anchor may be in the calibration that is in use, in the one that is being made, or in both. Its verdict is that of the
// calibration that is being made, which is the newer one.
export function anchors_of(moment: Moment): Anchor[] {
  const anchors = new Map<number, Anchor>();
  const of = (id: number): Anchor => {
    let anchor = anchors.get(id);
    if (!anchor) {
      const unknown = { coverage: NaN, ranges_used: NaN, sigma_m: NaN, drive_to_m: null, position_m: null, covariance_m2: null };
      anchor = { id, verdict: "", advice: "", state: "", ...unknown };
      anchors.set(id, anchor);
    }
    return anchor;
  };
  for (const { id, verdict } of moment.status?.anchors ?? []) of(id).verdict = verdict;
  for (const known of moment.anchor_set?.anchors ?? []) {
    const anchor = of(known.id);
    anchor.verdict = known.verdict || anchor.verdict;
    anchor.advice = known.advice;
    anchor.position_m = known.position_m;
    anchor.covariance_m2 = known.covariance_m2;
    const [xx, , , , yy] = known.covariance_m2 ?? [];
    if (xx !== undefined && yy !== undefined) anchor.sigma_m = Math.sqrt(Math.max(xx, yy));
  }
  for (const learning of moment.calibration?.anchors ?? []) {
    const anchor = of(learning.id);
    anchor.verdict = learning.verdict || anchor.verdict;
    anchor.advice = learning.advice || anchor.advice;
    anchor.state = learning.state;
    anchor.coverage = learning.coverage;
    anchor.ranges_used = learning.ranges_used;
    anchor.drive_to_m = learning.drive_to_m;
    if (!Number.isNaN(learning.sigma_m)) anchor.sigma_m = learning.sigma_m;
  }
  return [...anchors.values()].sort((a, b) => a.id - b.id);
}
