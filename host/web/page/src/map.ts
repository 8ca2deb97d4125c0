// The map: static content and trail from layers, and on top what moves with each pose.
import { attach_gestures, Camera } from "./camera";
import { length } from "./format";
import type { Pose } from "./history";
import { Layer } from "./layer";
import { draw_static, grid_step_m, kAnchor_px, kFont, overlaps, type Box } from "./map_static";
import { anchors_of, pairs_of, type Anchor, type Model, type Moment } from "./model";
import { draw_ellipse } from "./ellipse";
import { ellipse_95, quality, tag_position_m, type Quality } from "./quality";
import { kStates, type Tone } from "./states";
import type { Colours, Theme } from "./theme";

const kTrail_s = 600;
// Points of the trail that are closer on the screen are left out.
const kTrailStep_px = 2;
const kDriveHere = 3; // so many of the least covered anchors have a marker
const kPin_px = 9; // half the width of a marker
const kClickReach_px = 18;

export const kToneColour: Record<Tone, keyof Colours> = { good: "good", busy: "busy", warning: "warn", bad: "bad", idle: "idle" };
const kQualityLine: Record<Quality, { colour: keyof Colours; dash: number[] }> = {
  good: { colour: "good", dash: [] },
  fair: { colour: "warn", dash: [7, 4] },
  poor: { colour: "bad", dash: [2, 4] },
  unknown: { colour: "idle", dash: [1, 6] },
};

export interface MapListener {
  changed: () => void; // has to be drawn again
  anchor_picked: (id: number | null) => void;
  follow_changed: () => void;
}

export class MapView {
  follow = false;
  show_links = true;
  selected: number | null = null;
  private readonly camera = new Camera();
  private readonly context: CanvasRenderingContext2D;
  private readonly static_layer = new Layer();
  private readonly trail_layer = new Layer();
  private trail_first = 0;
  private trail_end = 0;
  private ratio = 1;
  private is_fitted = false;
  private was_moved = false;
  private shown: Anchor[] = [];
  private shown_of: Moment | null = null;
  private anchors_key = "";
  private anchor_boxes: Box[] = []; // of symbols and labels, in the static layer

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly theme: Theme,
    private readonly listener: MapListener,
  ) {
    this.context = canvas.getContext("2d")!;
    attach_gestures(canvas, this.camera, {
      moved: (is_pan) => {
        this.was_moved = true;
        if (is_pan) this.set_follow(false);
        listener.changed();
      },
      clicked: (x_px, y_px) => listener.anchor_picked(this.anchor_at(x_px, y_px)),
    });
    canvas.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  set_follow(follow: boolean): void {
    if (this.follow === follow) return;
    this.follow = follow;
    this.listener.follow_changed();
    this.listener.changed();
  }

  whole_site(): void {
    this.set_follow(false);
    this.is_fitted = this.was_moved = false;
    this.listener.changed();
  }

  zoom(factor: number): void {
    this.was_moved = true;
    this.camera.zoom(factor, this.camera.width_px / 2, this.camera.height_px / 2);
    this.listener.changed();
  }

  // Another site: the view does not fit it.
  reset(): void {
    this.whole_site();
    this.shown_of = null;
    this.trail_first = this.trail_end = 0;
    this.anchors_key = "";
  }

  // In the middle, if it is not visible.
  reveal(anchor: Anchor): void {
    if (!anchor.position_m) return;
    const [x_m = 0, y_m = 0] = anchor.position_m;
    const [x_px, y_px] = this.camera.to_px(x_m, y_m);
    if (x_px > 0 && y_px > 0 && x_px < this.camera.width_px && y_px < this.camera.height_px) return;
    this.set_follow(false);
    this.was_moved = true;
    this.camera.x_m = x_m;
    this.camera.y_m = y_m;
    this.listener.changed();
  }

  private key(event: KeyboardEvent): void {
    const pan: Record<string, [number, number]> = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
    const by = pan[event.key];
    if (!by || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    event.stopPropagation(); // else the time line takes the arrows
    this.camera.pan(...by);
    this.was_moved = true;
    this.set_follow(false);
    this.listener.changed();
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas;
    this.ratio = Math.min(2, window.devicePixelRatio || 1);
    this.camera.width_px = Math.max(1, clientWidth);
    this.camera.height_px = Math.max(1, clientHeight);
    this.canvas.width = Math.round(this.camera.width_px * this.ratio);
    this.canvas.height = Math.round(this.camera.height_px * this.ratio);
    if (!this.was_moved) this.is_fitted = false;
    this.listener.changed();
  }

  private anchor_at(x_px: number, y_px: number): number | null {
    let best: number | null = null;
    let best_px = kClickReach_px;
    for (const anchor of this.shown) {
      if (!anchor.position_m) continue;
      const [ax_px, ay_px] = this.camera.to_px(anchor.position_m[0]!, anchor.position_m[1]!);
      const far_px = Math.hypot(ax_px - x_px, ay_px - y_px);
      // Of anchors at one place, the next one is picked.
      if (far_px > best_px || anchor.id === this.selected) continue;
      best = anchor.id;
      best_px = far_px;
    }
    return best;
  }

  private fit(model: Model, moment: Moment): void {
    const xs: number[] = [];
    const ys: number[] = [];
    const add = ([x, y]: readonly (number | undefined)[]) => {
      if (!Number.isFinite(x) || !Number.isFinite(y)) return;
      xs.push(x!);
      ys.push(y!);
    };
    for (const wall of model.site?.walls ?? []) {
      add(wall.slice(0, 2));
      add(wall.slice(2, 4));
    }
    for (const floor of model.site?.floors ?? []) floor.outline_m?.forEach(add);
    for (const anchor of this.shown) {
      add(anchor.position_m ?? []);
      add(anchor.drive_to_m ?? []);
    }
    for (let i = model.poses.first(); i < model.poses.end(); i += 10) add([model.poses.number("x_m", i), model.poses.number("y_m", i)]);
    if (moment.pose) add([moment.pose.x_m, moment.pose.y_m]);
    if (xs.length === 0) return;
    this.camera.fit({ left: Math.min(...xs), right: Math.max(...xs), bottom: Math.min(...ys), top: Math.max(...ys) }, this.camera.width_px < 500 ? 28 : 48);
    this.is_fitted = model.site !== null && model.history !== "loading" && (xs.length > 1);
  }

  private refresh_anchors(model: Model, moment: Moment): void {
    const of = this.shown_of;
    if (of && of.status === moment.status && of.calibration === moment.calibration && of.anchor_set === moment.anchor_set) return;
    this.shown_of = moment;
    this.shown = anchors_of(moment);
    const placed = this.shown.map((anchor) => [anchor.id, anchor.verdict, anchor.position_m, anchor.covariance_m2, Math.round(100 * anchor.coverage)]);
    const key = JSON.stringify(placed);
    if (key === this.anchors_key) return;
    this.anchors_key = key;
    if (!this.was_moved && !this.follow && model.history !== "loading") this.is_fitted = false;
  }

  draw(model: Model, moment: Moment): void {
    this.refresh_anchors(model, moment);
    if (!this.is_fitted) this.fit(model, moment);
    const pose = moment.pose;
    if (this.follow && pose) {
      this.camera.x_m = pose.x_m;
      this.camera.y_m = pose.y_m;
    }
    const { context, camera, ratio } = this;
    const colours = this.theme.colours;
    this.update_static(model, moment);
    this.update_trail(model, moment);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = colours.paper;
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    this.static_layer.copy_to(context, camera, ratio);
    this.trail_layer.copy_to(context, camera, ratio);
    if (this.show_links && pose) this.draw_links(model, moment, pose);
    this.draw_drive_here();
    if (pose) this.draw_robot(model, pose);
    this.draw_scale();
  }

  private update_static(model: Model, moment: Moment): void {
    const is_calibrating = moment.calibration?.anchors.some((anchor) => anchor.coverage < 1) ?? false;
    const cells = is_calibrating ? driven_cells(model, moment) : new Set<string>();
    const floor = moment.pose?.floor ?? "";
    const key = [document.documentElement.dataset.theme, this.anchors_key, this.selected, floor, cells.size, model.counts.SITE].join(" ");
    if (this.static_layer.is_valid(this.camera, this.ratio, key)) return;
    this.static_layer.begin(this.camera, this.ratio, key);
    const content = { site: model.site, anchors: this.shown, floor, selected: this.selected, driven_cells: cells };
    this.anchor_boxes = draw_static(this.static_layer.context, this.static_layer.camera, this.theme.colours, content);
  }

  private update_trail(model: Model, moment: Moment): void {
    const { poses } = model;
    const first = poses.end_at(moment.at_s - kTrail_s);
    const end = moment.is_latest ? poses.end() : poses.end_at(moment.at_s);
    const key = document.documentElement.dataset.theme ?? "";
    const is_longer = end >= this.trail_end && this.trail_end >= poses.first();
    // The begin of the trail is cut in steps of a few seconds.
    const is_valid = this.trail_layer.is_valid(this.camera, this.ratio, key) && is_longer && first >= this.trail_first && first - this.trail_first < 25;
    if (!is_valid) {
      this.trail_layer.begin(this.camera, this.ratio, key);
      this.trail_first = this.trail_end = first;
    }
    if (end === this.trail_end) return;
    this.draw_trail(model, Math.max(this.trail_first, this.trail_end - 1), end);
    this.trail_end = end;
  }

  private draw_trail(model: Model, begin: number, end: number): void {
    const { context, camera } = this.trail_layer;
    const { poses } = model;
    context.lineWidth = 1.8;
    context.lineJoin = "round";
    let state: string | null = null;
    let [last_x, last_y] = [NaN, NaN];
    const finish = () => {
      if (state !== null) context.stroke();
    };
    for (let i = begin; i < end; i++) {
      const [x, y] = camera.to_px(poses.number("x_m", i), poses.number("y_m", i));
      const here = poses.state(i);
      if (here !== state) {
        finish();
        state = here;
        const tone = kStates[state]?.tone ?? "warning";
        context.strokeStyle = this.theme.colours[kToneColour[tone]];
        // Not by colour alone: where the pose is not valid, the trail is dashed.
        context.setLineDash(tone === "good" ? [] : tone === "bad" ? [1.5, 3.5] : [5, 3]);
        context.beginPath();
        context.moveTo(Number.isNaN(last_x) ? x : last_x, Number.isNaN(last_y) ? y : last_y);
      } else if (i < end - 1 && Math.abs(x - last_x) + Math.abs(y - last_y) < kTrailStep_px) {
        continue;
      }
      context.lineTo(x, y);
      [last_x, last_y] = [x, y];
    }
    finish();
    context.setLineDash([]);
  }

  private draw_links(model: Model, moment: Moment, pose: Pose): void {
    const { context, camera } = this;
    const places = new Map(this.shown.filter((anchor) => anchor.position_m).map((anchor) => [anchor.id, anchor.position_m!]));
    const levers = new Map(model.site?.tags.map((tag) => [tag.id, tag.lever_arm_m]));
    const lines = new Map<Quality, [number, number, number, number][]>();
    for (const pair of pairs_of(moment.status)) {
      const place = places.get(pair.anchor);
      if (!place || (this.selected !== null && pair.anchor !== this.selected)) continue;
      const [tag_x_m, tag_y_m] = tag_position_m(pose, levers.get(pair.tag) ?? [0, 0]);
      const of = quality(pair.gated_share, pair.innovation_m);
      const list = lines.get(of) ?? [];
      list.push([...camera.to_px(tag_x_m, tag_y_m), ...camera.to_px(place[0]!, place[1]!)]);
      lines.set(of, list);
    }
    context.lineWidth = this.selected === null ? 1 : 1.8;
    context.globalAlpha = this.selected === null ? 0.5 : 0.95;
    for (const [of, list] of lines) {
      context.strokeStyle = this.theme.colours[kQualityLine[of].colour];
      context.setLineDash(kQualityLine[of].dash);
      context.beginPath();
      for (const [x0, y0, x1, y1] of list) {
        // The symbol of the anchor stays free.
        const far = Math.hypot(x1 - x0, y1 - y0);
        const stop = far > 2 * kAnchor_px ? 1 - (kAnchor_px + 2) / far : 1;
        context.moveTo(x0, y0);
        context.lineTo(x0 + (x1 - x0) * stop, y0 + (y1 - y0) * stop);
      }
      context.stroke();
    }
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  private draw_drive_here(): void {
    const { context, camera } = this;
    const colours = this.theme.colours;
    const wanted = this.shown.filter((anchor) => anchor.drive_to_m !== null && anchor.coverage < 1);
    wanted.sort((a, b) => a.coverage - b.coverage);
    context.font = `600 12px ${kFont}`;
    context.textBaseline = "middle";
    const pins: { anchor: Anchor; x: number; y: number }[] = [];
    for (const anchor of wanted) {
      const [x, y] = camera.to_px(...anchor.drive_to_m!);
      // Anchors that stand together ask for the same place: one pin is enough.
      if (pins.length < kDriveHere && pins.every((pin) => Math.hypot(pin.x - x, pin.y - y) > 2 * kPin_px)) pins.push({ anchor, x, y });
    }
    context.textAlign = "center";
    pins.forEach(({ x, y }, order) => {
      // The tip is the place.
      context.beginPath();
      context.moveTo(x, y);
      context.bezierCurveTo(x - 3, y - 8, x - kPin_px, y - 11, x - kPin_px, y - 18);
      context.arc(x, y - 18, kPin_px, Math.PI, 0);
      context.bezierCurveTo(x + kPin_px, y - 11, x + 3, y - 8, x, y);
      context.fillStyle = colours.busy;
      context.strokeStyle = colours.card;
      context.lineWidth = 2;
      context.stroke();
      context.fill();
      context.fillStyle = colours.card;
      context.fillText(String(order + 1), x, y - 17.5);
    });
    context.textAlign = "left";
    const is_narrow = camera.width_px < 560;
    const [dx, dy] = camera.to_px(...this.static_layer.camera.to_m(0, 0));
    const taken = this.anchor_boxes.map((box) => ({ left: box.left + dx, right: box.right + dx, top: box.top + dy, bottom: box.bottom + dy }));
    for (const { x, y } of pins) taken.push({ left: x - kPin_px, right: x + kPin_px, top: y - 18 - kPin_px, bottom: y });
    pins.forEach(({ anchor, x, y }, order) => {
      if (is_narrow && order > 0) return;
      const label = order > 0 ? `Anchor ${anchor.id}` : is_narrow ? "Drive here next" : `Drive here next (anchor ${anchor.id})`;
      const width_px = context.measureText(label).width;
      const places = [[x + 13, y - 18], [x - 13 - width_px, y - 18], [x - width_px / 2, y - 36], [x - width_px / 2, y + 10]] as const;
      const is_free = ([left, middle]: readonly [number, number]) => {
        const box = { left, right: left + width_px, top: middle - 7, bottom: middle + 7 };
        return left >= 0 && box.right <= camera.width_px && box.top >= 0 && !taken.some((other) => overlaps(box, other));
      };
      // The first one is what the driver needs; of the others a label is left out where it has no place.
      const place = places.find(is_free) ?? (order === 0 ? places[x + 13 + width_px <= camera.width_px ? 0 : 1] : null);
      if (!place) return;
      taken.push({ left: place[0], right: place[0] + width_px, top: place[1] - 7, bottom: place[1] + 7 });
      context.strokeStyle = colours.card;
      context.lineWidth = 4;
      context.strokeText(label, ...place);
      context.fillStyle = colours.ink;
      context.fillText(label, ...place);
    });
  }

  private draw_robot(model: Model, pose: Pose): void {
    const { context, camera } = this;
    const colours = this.theme.colours;
    const [x, y] = camera.to_px(pose.x_m, pose.y_m);
    const colour = colours[kToneColour[kStates[pose.state]?.tone ?? "warning"]];
    const ellipse = ellipse_95(pose.xx_m2, pose.xy_m2, pose.yy_m2);
    if (ellipse) draw_ellipse(context, camera, [x, y], ellipse, { colour: colours.estimate, fill: 0.16, line: 0.9, width_px: 1.3 });
    // Its size is that of a small vehicle, and never too small to see.
    const r = Math.max(11, 0.45 * camera.px_per_m);
    const [cos, sin] = [Math.cos(pose.yaw_rad), -Math.sin(pose.yaw_rad)];
    context.beginPath();
    for (const [forward, left] of [[1.35, 0], [0.55, 0.7], [-1, 0.7], [-1, -0.7], [0.55, -0.7]] as const) {
      context.lineTo(x + r * (cos * forward + sin * left), y + r * (sin * forward - cos * left));
    }
    context.closePath();
    context.lineJoin = "round";
    context.lineWidth = 4;
    context.strokeStyle = colours.card;
    context.stroke();
    context.globalAlpha = 0.85;
    context.fillStyle = colour;
    context.fill();
    context.globalAlpha = 1;
    context.lineWidth = 1.5;
    context.strokeStyle = colours.ink;
    context.stroke();
    for (const tag of model.site?.tags ?? []) {
      const [tag_x, tag_y] = camera.to_px(...tag_position_m(pose, tag.lever_arm_m));
      context.beginPath();
      context.arc(tag_x, tag_y, 3, 0, 2 * Math.PI);
      context.fillStyle = colours.card;
      context.fill();
      context.stroke();
    }
  }

  private draw_scale(): void {
    const { context, camera } = this;
    const colours = this.theme.colours;
    const bar_m = grid_step_m(camera.px_per_m, 60);
    const width_px = bar_m * camera.px_per_m;
    const [x, y] = [14, camera.height_px - 14];
    context.beginPath();
    context.moveTo(x + 0.5, y - 5);
    context.lineTo(x + 0.5, y + 0.5);
    context.lineTo(x + width_px + 0.5, y + 0.5);
    context.lineTo(x + width_px + 0.5, y - 5);
    for (const [colour, width] of [[colours.card, 5], [colours.ink, 1.5]] as const) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.stroke();
    }
    context.font = `12px ${kFont}`;
    context.textAlign = "left";
    context.textBaseline = "bottom";
    const label = bar_m >= 1 ? `${bar_m} m` : length(bar_m);
    context.lineWidth = 4;
    context.strokeStyle = colours.card;
    context.strokeText(label, x + 5, y - 3);
    context.fillStyle = colours.ink;
    context.fillText(label, x + 5, y - 3);
  }
}

let cells_of = { end: -1, first: -1, cells: new Set<string>() };

// Cells of 1 m that the robot passed. Recomputed once for each second of new poses only.
function driven_cells(model: Model, moment: Moment): Set<string> {
  const first = model.poses.first();
  const end = model.poses.end_at(moment.at_s);
  if (first === cells_of.first && Math.abs(end - cells_of.end) < 5) return cells_of.cells;
  const cells = new Set<string>();
  for (let i = first; i < end; i++) cells.add(`${Math.floor(model.poses.number("x_m", i))} ${Math.floor(model.poses.number("y_m", i))}`);
  cells_of = { end, first, cells };
  return cells;
}
