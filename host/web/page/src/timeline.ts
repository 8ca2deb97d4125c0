// The time line: bands of the state, the position's sigma and ranges a second. A slider for keyboard and screen readers.
import { duration } from "./format";
import { kFont } from "./map_static";
import { kToneColour } from "./map";
import type { Model } from "./model";
import { sigma_m } from "./quality";
import { kStates } from "./states";
import type { Colours, Theme } from "./theme";

const kLeft_px = 58;
const kRight_px = 10;
const kBand = { top: 6, height: 14 };
const kSigma = { top: 26, height: 34 };
const kRanges = { top: 66, height: 22 };
const kAxis_px = 103;
const kLeastSpan_s = 60;
// Sigmas are drawn by their logarithm, between these.
const kSigma_m = [0.005, 5] as const;

export interface TimelineListener {
  moved: (at_s: number) => void;
  step: (by_s: number) => void;
  live: () => void;
}

export class Timeline {
  private readonly context: CanvasRenderingContext2D;
  private readonly drawing = document.createElement("canvas"); // all but the cursor
  private ratio = 1;
  private width_px = 1;
  private height_px = 1;
  private begin_s = 0;
  private end_s = 1;
  private has_data = false;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly slider: HTMLElement,
    private readonly theme: Theme,
    listener: TimelineListener,
    private readonly changed: () => void,
  ) {
    this.context = canvas.getContext("2d")!;
    let is_down = false;
    const move = (event: PointerEvent) => listener.moved(this.to_s(event.offsetX));
    slider.addEventListener("pointerdown", (event) => {
      if (event.button > 0) return;
      is_down = true;
      slider.setPointerCapture(event.pointerId);
      move(event);
    });
    slider.addEventListener("pointermove", (event) => is_down && move(event));
    for (const end of ["pointerup", "pointercancel"]) slider.addEventListener(end, () => (is_down = false));
    slider.addEventListener("keydown", (event) => {
      if (event.key === "Home") listener.moved(this.begin_s);
      else if (event.key === "End") listener.live();
      else if (event.key === "PageUp") listener.step(60);
      else if (event.key === "PageDown") listener.step(-60);
      else return;
      event.preventDefault();
    });
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  private resize(): void {
    this.ratio = Math.min(2, window.devicePixelRatio || 1);
    this.width_px = Math.max(1, this.canvas.clientWidth);
    this.height_px = Math.max(1, this.canvas.clientHeight);
    for (const canvas of [this.canvas, this.drawing]) {
      canvas.width = Math.round(this.width_px * this.ratio);
      canvas.height = Math.round(this.height_px * this.ratio);
    }
    this.changed();
  }

  private to_px(at_s: number): number {
    return kLeft_px + ((at_s - this.begin_s) / (this.end_s - this.begin_s)) * (this.width_px - kLeft_px - kRight_px);
  }

  private to_s(x_px: number): number {
    const share = (x_px - kLeft_px) / (this.width_px - kLeft_px - kRight_px);
    return this.begin_s + Math.min(1, Math.max(0, share)) * (this.end_s - this.begin_s);
  }

  // is_live: the right end is now; otherwise times count from the begin of the file.
  draw_content(model: Model, now_s: number, is_live: boolean): void {
    const context = this.drawing.getContext("2d")!;
    const colours = this.theme.colours;
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.clearRect(0, 0, this.width_px, this.height_px);
    const oldest_s = model.oldest_at_s();
    if (!Number.isNaN(oldest_s)) {
      this.end_s = is_live ? now_s : model.newest_at_s();
      this.begin_s = is_live ? Math.max(this.end_s - model.limits.horizon_s, Math.min(oldest_s, this.end_s - kLeastSpan_s)) : oldest_s;
      if (this.end_s <= this.begin_s) this.end_s = this.begin_s + 1;
      this.draw_bands(context, colours, model);
      this.draw_sigma(context, colours, model);
      this.draw_ranges(context, colours, model);
      this.draw_axis(context, colours, is_live);
    } else {
      context.font = `13px ${kFont}`;
      context.fillStyle = colours.soft;
      context.textAlign = "center";
      context.textBaseline = "middle";
      context.fillText("No data yet", this.width_px / 2, this.height_px / 2);
    }
    this.has_data = !Number.isNaN(oldest_s);
  }

  draw_cursor(at_s: number | null): void {
    const { context } = this;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    context.drawImage(this.drawing, 0, 0);
    if (!this.has_data) return;
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    const x = Math.round(this.to_px(at_s ?? this.end_s)) + 0.5;
    context.strokeStyle = context.fillStyle = at_s === null ? this.theme.colours.soft : this.theme.colours.ink;
    context.lineWidth = at_s === null ? 1 : 2;
    context.beginPath();
    context.moveTo(x, 2);
    context.lineTo(x, kRanges.top + kRanges.height);
    context.stroke();
    if (at_s === null) return;
    context.beginPath();
    context.moveTo(x - 6, 0);
    context.lineTo(x + 6, 0);
    context.lineTo(x, 8);
    context.fill();
  }

  describe(at_s: number | null, is_live: boolean, state: string): void {
    const at = at_s ?? this.end_s;
    const where = at_s === null ? "now" : is_live ? `${duration(this.end_s - at)} ago` : `at ${duration(at - this.begin_s)}`;
    const set = (name: string, value: string) => {
      if (this.slider.getAttribute(name) !== value) this.slider.setAttribute(name, value);
    };
    set("aria-valuemin", String(Math.round(this.begin_s - this.end_s)));
    set("aria-valuemax", "0");
    set("aria-valuenow", String(Math.round(at - this.end_s)));
    set("aria-valuetext", `${where}: ${state}`);
  }

  // States by STATUS, and by poses where they are: poses alone know short changes, STATUS alone knows states without a pose.
  private draw_bands(context: CanvasRenderingContext2D, colours: Colours, model: Model): void {
    const fill = (from_s: number, to_s: number, state: string) => {
      const tone = kStates[state]?.tone ?? "warning";
      const left = Math.round(Math.max(kLeft_px, this.to_px(from_s)));
      const width = Math.max(1, Math.round(this.to_px(to_s)) - left);
      context.fillStyle = colours[kToneColour[tone]];
      // Height as well as colour: the lower the band, the worse the state.
      const share = { good: 1, busy: 0.6, warning: 0.6, bad: 0.35, idle: 0.2 }[tone];
      const height = kBand.height * share;
      context.fillRect(left, kBand.top + kBand.height - height, width, height);
    };
    const { items } = model.statuses;
    items.forEach((status, i) => fill(status.at_s, Math.min(items[i + 1]?.at_s ?? this.end_s, status.at_s + 5), status.state));
    const { poses } = model;
    let begin = poses.first();
    for (let i = begin + 1; i <= poses.end(); i++) {
      const previous_s = poses.number("at_s", i - 1);
      const at_s = i < poses.end() ? poses.number("at_s", i) : previous_s;
      const is_gap = at_s - previous_s > 2;
      if (i < poses.end() && !is_gap && poses.state(i) === poses.state(begin)) continue;
      const left = Math.round(this.to_px(poses.number("at_s", begin)));
      const right = Math.round(this.to_px(is_gap ? previous_s : at_s));
      context.clearRect(left, kBand.top, right - left, kBand.height);
      fill(poses.number("at_s", begin), is_gap ? previous_s : at_s, poses.state(begin));
      begin = i;
    }
  }

  private draw_sigma(context: CanvasRenderingContext2D, colours: Colours, model: Model): void {
    const { poses } = model;
    const [low_m, high_m] = kSigma_m;
    const to_y = (value_m: number) => {
      const share = Math.log(Math.min(high_m, Math.max(low_m, value_m)) / low_m) / Math.log(high_m / low_m);
      return kSigma.top + kSigma.height * (1 - share);
    };
    context.strokeStyle = colours.grid;
    context.lineWidth = 1;
    for (const value_m of [0.01, 0.1, 1]) {
      const y = Math.round(to_y(value_m)) + 0.5;
      context.beginPath();
      context.moveTo(kLeft_px, y);
      context.lineTo(this.width_px - kRight_px, y);
      context.stroke();
    }
    this.label(context, colours, "1 m", to_y(1));
    this.label(context, colours, "10 cm", to_y(0.1));
    this.label(context, colours, "1 cm", to_y(0.01));
    // One point for each column of the screen: its largest sigma.
    context.strokeStyle = colours.estimate;
    context.lineWidth = 1.5;
    context.beginPath();
    let column = -1;
    let worst_m = 0;
    let last_s = -Infinity;
    const put = (is_gap: boolean) => {
      if (column < 0) return;
      if (is_gap) context.moveTo(column, to_y(worst_m));
      else context.lineTo(column, to_y(worst_m));
    };
    let starts = true;
    for (let i = poses.first(); i < poses.end(); i++) {
      const sigma = sigma_m(poses.number("xx_m2", i), poses.number("xy_m2", i), poses.number("yy_m2", i));
      if (Number.isNaN(sigma)) continue;
      const at_s = poses.number("at_s", i);
      const x = Math.round(this.to_px(at_s));
      const is_gap = at_s - last_s > 2;
      if (x !== column || is_gap) {
        put(starts);
        starts = is_gap;
        column = x;
        worst_m = 0;
      }
      worst_m = Math.max(worst_m, sigma);
      last_s = at_s;
    }
    put(starts);
    context.stroke();
  }

  private draw_ranges(context: CanvasRenderingContext2D, colours: Colours, model: Model): void {
    const { items } = model.statuses;
    let most_hz = 0;
    for (const status of items) if (status.ranges_hz > most_hz) most_hz = status.ranges_hz;
    const top_hz = nice(most_hz);
    const bottom = kRanges.top + kRanges.height;
    context.fillStyle = colours.soft;
    context.globalAlpha = 0.45;
    items.forEach((status, i) => {
      if (!(status.ranges_hz > 0) || status.at_s <= this.begin_s) return;
      const left = i > 0 ? Math.max(items[i - 1]!.at_s, status.at_s - 5) : status.at_s - 2;
      // Whole pixels: bars that overlap, or leave a gap, would look like a pattern.
      const x = Math.round(Math.max(kLeft_px, this.to_px(left)));
      const height = (kRanges.height * status.ranges_hz) / top_hz;
      context.fillRect(x, bottom - height, Math.round(this.to_px(status.at_s)) - x, height);
    });
    context.globalAlpha = 1;
    context.strokeStyle = colours.rule;
    context.beginPath();
    context.moveTo(kLeft_px, bottom + 0.5);
    context.lineTo(this.width_px - kRight_px, bottom + 0.5);
    context.stroke();
    this.label(context, colours, most_hz > 0 ? `${top_hz} /s` : "ranges", kRanges.top + 6);
  }

  private draw_axis(context: CanvasRenderingContext2D, colours: Colours, is_live: boolean): void {
    this.label(context, colours, "state", kBand.top + kBand.height / 2);
    const span_s = this.end_s - this.begin_s;
    const least_s = (span_s * 64) / Math.max(64, this.width_px - kLeft_px - kRight_px);
    const step_s = [5, 10, 30, 60, 120, 300, 600, 1800, 3600].find((step) => step >= least_s) ?? 7200;
    context.fillStyle = colours.soft;
    context.strokeStyle = colours.rule;
    context.font = `11px ${kFont}`;
    context.textBaseline = "alphabetic";
    for (let i = 0; i * step_s <= span_s; i++) {
      const x = Math.round(this.to_px(is_live ? this.end_s - i * step_s : this.begin_s + i * step_s)) + 0.5;
      context.beginPath();
      context.moveTo(x, kRanges.top + kRanges.height);
      context.lineTo(x, kRanges.top + kRanges.height + 4);
      context.stroke();
      const text = i === 0 && is_live ? "now" : `${is_live ? "−" : ""}${duration(i * step_s)}`;
      const half = context.measureText(text).width / 2;
      context.textAlign = "center";
      context.fillText(text, Math.min(this.width_px - half - 1, Math.max(half, x)), kAxis_px);
    }
  }

  private label(context: CanvasRenderingContext2D, colours: Colours, text: string, y: number): void {
    context.font = `11px ${kFont}`;
    context.fillStyle = colours.soft;
    context.textAlign = "right";
    context.textBaseline = "middle";
    context.fillText(text, kLeft_px - 8, y);
  }
}

function nice(value: number): number {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([1, 2, 5].find((factor) => factor * power >= value) ?? 10);
}

