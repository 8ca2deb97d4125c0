// The tables and key figures beside the map.
import { DataTable, h, set_text, tabs } from "./dom";
import { count, degrees, duration, fixed, kUnknown, length, percent, with_unit } from "./format";
import { anchors_of, pairs_of, type Anchor, type Link, type LogLine, type Model, type Moment, type Pair } from "./model";
import { ellipse_95, quality, sigma_m } from "./quality";
import { kVerdicts } from "./states";
import { Slots } from "./slots";
import { symbol_of } from "./symbols";

const kLogShown = 200;

const kFigures: [name: string, hint: string][] = [
  ["Sigma", "Standard deviation of the position in its worst direction"],
  ["x", "Position of base_link in the map"],
  ["y", "Position of base_link in the map"],
  ["Heading", "From the map's x axis, positive to the left"],
  ["Speed", "By odometry, corrected"],
  ["Driven", "Path by odometry since gromad started"],
  ["Ranges", "Passed on a second"],
  ["Odometry", "Samples passed on a second"],
  ["Dropped", "Ranges without a distance, and measurements that were late, malformed or implausible"],
  ["Lost", "Reports lost in a node's queue or on its link"],
  ["Latency p50 / p99", "From an odometry sample to its pose: half and 99 % of the poses take no longer"],
];

interface LinkRow extends Link {
  is_robot: boolean;
}

const kCalibrationStates: Record<string, string> = { known: "in use", learning: "being calibrated", live: "in use, calibrated here", moved: "moved, being calibrated again" };

export class Panels {
  readonly figures = h("dl", { class: "figures", "aria-label": "Key figures" });
  readonly element: HTMLElement;
  private readonly values = new Map<string, HTMLElement>();
  private readonly anchors: DataTable<Anchor>;
  private readonly pairs: DataTable<Pair>;
  private readonly links: DataTable<LinkRow>;
  private readonly details = h("section", { class: "details", "aria-label": "Selected anchor" });
  private readonly detail_values = new Map<string, HTMLElement>();
  private readonly detail_title = h("h3");
  private readonly detail_advice = h("p", { class: "advice" });
  private readonly verdict = h("p", { class: "hint" });
  private readonly slots = new Slots();
  private readonly log = h("ol", { class: "log", tabindex: 0, "aria-label": "Log of gromad" });
  private readonly log_empty = h("p", { class: "empty" }, "No log line yet.");
  private log_shown = "";
  private readonly select_tab: (index: number) => void;
  private tab = 0;

  constructor(
    private readonly selection: { get: () => number | null; set: (id: number | null) => void },
    private readonly changed: () => void,
  ) {
    this.anchors = new DataTable<Anchor>(
      "Anchors: a row chooses one on the map",
      [
        { title: "Anchor", text: (a) => String(a.id), order: (a) => a.id, mark: (a) => `shape-${symbol_of(a.verdict).shape} tone-${symbol_of(a.verdict).colour}` },
        { title: "Verdict", text: (a) => kVerdicts[a.verdict] ?? (a.verdict || kUnknown), order: (a) => a.verdict, words: true, tone: (a) => `tone-${symbol_of(a.verdict).colour}` },
        { title: "Sigma", hint: "Standard deviation of the position, the larger of x and y", text: (a) => length(a.sigma_m), order: (a) => a.sigma_m },
        { title: "Coverage", hint: "Share of the needed information", text: (a) => percent(a.coverage), order: (a) => a.coverage },
      ],
      (anchor) => String(anchor.id),
      "No anchor is calibrated yet.",
      {
        label: (anchor) => `Anchor ${anchor.id}: details and map`,
        select: (anchor) => selection.set(selection.get() === anchor.id ? null : anchor.id),
        is_selected: (anchor) => selection.get() === anchor.id,
      },
      (anchor) => anchor.advice,
    );
    this.pairs = new DataTable<Pair>(
      "Pairs of tag and anchor with a range in the last 5 s",
      [
        { title: "Tag", text: (p) => String(p.tag), order: (p) => p.tag, mark: (p) => `line-${quality(p.gated_share, p.innovation_m)}` },
        { title: "Anchor", text: (p) => String(p.anchor), order: (p) => p.anchor },
        { title: "Range", hint: "Smoothed over some 5 ranges", text: (p) => with_unit(p.range_m, 2, "m"), order: (p) => p.range_m },
        { title: "Innovation", hint: "Root mean square of measured minus predicted", text: (p) => length(p.innovation_m), order: (p) => p.innovation_m, tone: (p) => tone_of(quality(NaN, p.innovation_m)) },
        { title: "Gated", hint: "Share of the ranges of the last 5 s that the filter refused", text: (p) => percent(p.gated_share), order: (p) => p.gated_share, tone: (p) => tone_of(quality(p.gated_share, NaN)) },
        { title: "Ranges", hint: "Since gromad started", text: (p) => count(p.ranges), order: (p) => p.ranges },
      ],
      (pair) => `${pair.tag} ${pair.anchor}`,
      "No range in the last 5 s.",
    );
    this.links = new DataTable<LinkRow>(
      "Links and nodes",
      [
        { title: "Node", text: link_name, order: link_name, mark: (l) => (l.open ? "shape-circle tone-good" : "shape-cross tone-bad") },
        { title: "Sync", text: (l) => l.sync ?? kUnknown, tone: (l) => (l.sync === null || l.sync === "locked" ? "" : "tone-warn") },
        { title: "Ranges/s", text: (l) => fixed(l.ranges_hz, 0), order: (l) => l.ranges_hz },
        { title: "Frames/s", text: (l) => fixed(l.frames_hz, 0), order: (l) => l.frames_hz },
        { title: "Delay", hint: "Round trip over the link", text: (l) => with_unit(1000 * l.round_trip_s, 1, "ms"), order: (l) => l.round_trip_s },
      ],
      (link) => `${link.is_robot} ${link.link}`,
      "No link is reported.",
      undefined,
      link_note,
    );
    for (const [name, hint] of kFigures) this.add(this.figures, this.values, name, hint);
    const detail_list = h("dl", {});
    for (const name of ["Verdict", "Position", "95 % ellipse", "Calibration", "Coverage", "Ranges used", "Ranges now", "Drive to"]) this.add(detail_list, this.detail_values, name);
    const close = h("button", { type: "button", click: () => selection.set(null) }, "Close");
    this.details.append(h("div", { class: "row" }, this.detail_title, close), detail_list, this.detail_advice);
    const { element, select } = tabs(
      "Details",
      [
        { name: "Anchors", content: h("div", {}, this.verdict, this.details, this.anchors.element) },
        { name: "Links", content: h("div", {}, this.links.element) },
        { name: "Pairs", content: h("div", {}, this.pairs.element) },
        { name: "Slots", content: h("div", {}, this.slots.element) },
        { name: "Log", content: h("div", {}, this.log, this.log_empty) },
      ],
      (index) => {
        this.tab = index;
        this.changed();
      },
    );
    this.element = element;
    this.select_tab = select;
  }

  private add(list: HTMLElement, values: Map<string, HTMLElement>, name: string, hint: string | null = null): void {
    const value = h("dd", {}, kUnknown);
    values.set(name, value);
    list.append(h("div", { title: hint }, h("dt", {}, name), value));
  }

  show_anchors(): void {
    this.select_tab(0);
  }

  // The figures that follow each pose.
  show_figures(moment: Moment): void {
    const { pose, status } = moment;
    const set = (name: string, text: string) => set_text(this.values.get(name)!, text);
    set("Sigma", length(pose ? sigma_m(pose.xx_m2, pose.xy_m2, pose.yy_m2) : NaN));
    set("x", with_unit(pose?.x_m ?? NaN, 2, "m"));
    set("y", with_unit(pose?.y_m ?? NaN, 2, "m"));
    set("Heading", degrees(pose?.yaw_rad ?? NaN));
    set("Speed", with_unit(pose ? Math.hypot(pose.vx_mps, pose.vy_mps) : NaN, 2, "m/s"));
    set("Ranges", with_unit(status?.ranges_hz ?? NaN, 0, "/s"));
    set("Odometry", with_unit(status?.odometry_hz ?? NaN, 0, "/s"));
    set("Dropped", with_unit(status?.dropped_hz ?? NaN, 0, "/s"));
    set("Lost", with_unit(status?.lost_hz ?? NaN, 0, "/s"));
    const [p50, p99] = [status?.latency_p50_s ?? NaN, status?.latency_p99_s ?? NaN].map((value) => fixed(1000 * value, 1));
    set("Latency p50 / p99", p50 === kUnknown && p99 === kUnknown ? kUnknown : `${p50} / ${p99} ms`);
    set("Driven", with_unit(status?.driven_m ?? NaN, 0, "m"));
  }

  // Only the tab that is visible.
  show_tables(model: Model, moment: Moment): void {
    const { status } = moment;
    switch (this.tab) {
      case 0: {
        const anchors = anchors_of(moment);
        this.anchors.update(anchors);
        this.show_details(anchors, moment);
        const verdict = moment.calibration?.verdict || moment.anchor_set?.verdict;
        set_text(this.verdict, verdict ? `Calibration: ${verdict}` : "");
        break;
      }
      case 1:
        this.links.update([
          ...(status?.links ?? []).map((link) => ({ ...link, is_robot: false })),
          ...(status?.robots ?? []).map((link) => ({ ...link, is_robot: true })),
        ]);
        break;
      case 2:
        this.pairs.update(pairs_of(status));
        break;
      case 3:
        this.slots.update(status?.links ?? []);
        break;
      case 4:
        this.show_log(model, moment);
    }
  }

  private show_details(anchors: Anchor[], moment: Moment): void {
    const anchor = anchors.find((of) => of.id === this.selection.get());
    this.details.hidden = anchor === undefined;
    if (!anchor) return;
    set_text(this.detail_title, `Anchor ${anchor.id}`);
    const set = (name: string, text: string) => set_text(this.detail_values.get(name)!, text);
    const [x = NaN, y = NaN, z = NaN] = anchor.position_m ?? [];
    set("Verdict", kVerdicts[anchor.verdict] ?? (anchor.verdict || kUnknown));
    set("Position", anchor.position_m ? `${fixed(x, 2)}, ${fixed(y, 2)}, ${fixed(z, 2)} m` : "not known yet");
    set("95 % ellipse", ellipse_text(anchor));
    set("Calibration", kCalibrationStates[anchor.state] ?? (anchor.state || kUnknown));
    set("Coverage", percent(anchor.coverage));
    set("Ranges used", count(anchor.ranges_used));
    const pairs = pairs_of(moment.status).filter((pair) => pair.anchor === anchor.id);
    set("Ranges now", pairs.length === 0 ? "none in 5 s" : pairs.map((pair) => `tag ${pair.tag}: ${with_unit(pair.range_m, 2, "m")}`).join(", "));
    set("Drive to", anchor.drive_to_m ? anchor.drive_to_m.map((value) => fixed(value, 1)).join(", ") + " m" : kUnknown);
    set_text(this.detail_advice, anchor.advice);
  }

  private show_log(model: Model, moment: Moment): void {
    const end = moment.is_latest ? model.logs.items.length : model.logs.index_at(moment.at_s) + 1;
    const lines = model.logs.items.slice(Math.max(0, end - kLogShown), end);
    const last = lines[lines.length - 1];
    const shown = `${model.counts.LOG} ${lines.length} ${last?.at_s}`;
    if (shown === this.log_shown) return;
    this.log_shown = shown;
    this.log_empty.hidden = lines.length > 0;
    this.log.replaceChildren(...lines.reverse().map(log_line)); // the newest first
  }
}

function log_line(line: LogLine): HTMLElement {
  return h("li", {}, h("time", {}, Number.isNaN(line.t_s) ? kUnknown : line.t_s > 1e8 ? new Date(1000 * line.t_s).toLocaleTimeString() : duration(line.t_s)), " ", line.text);
}

function link_name(link: LinkRow): string {
  if (link.is_robot) return "robot";
  return link.id === null ? "node ?" : `${link.role ?? "node"} ${link.id}`;
}

function link_note(link: LinkRow): string {
  const radio = link.radio_error && `radio failed: ${link.radio_error}`;
  const damaged = link.frames_dropped > 0 ? `${count(link.frames_dropped)} damaged frames` : null;
  const discarded = link.bytes_discarded > 0 ? `${count(link.bytes_discarded)} bytes discarded` : null;
  const state = link.open ? "open" : `not open${link.error ? `: ${link.error}` : ""}`;
  return [`${link.link}: ${state}`, link.version && `version ${link.version}`, radio, damaged, discarded].filter(Boolean).join("; ");
}

function tone_of(of: ReturnType<typeof quality>): string {
  return { good: "", fair: "tone-warn", poor: "tone-bad", unknown: "" }[of];
}

function ellipse_text(anchor: Anchor): string {
  const [xx = NaN, xy = NaN, , , yy = NaN, , , , zz = NaN] = anchor.covariance_m2 ?? [];
  const ellipse = ellipse_95(xx, xy, yy);
  return ellipse ? `± ${length(ellipse.major_m)} by ± ${length(ellipse.minor_m)}, height ± ${length(1.96 * Math.sqrt(zz))}` : kUnknown;
}
