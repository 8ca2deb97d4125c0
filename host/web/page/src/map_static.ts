// What of the map seldom changes: grid, floors, walls, anchors with their ellipses, labels and coverage.
import type { Camera } from "./camera";
import { draw_ellipse } from "./ellipse";
import type { Anchor, Site } from "./model";
import { ellipse_95 } from "./quality";
import { draw_symbol, symbol_of } from "./symbols";
import type { Colours } from "./theme";

export const kAnchor_px = 6;
export const kFont = 'system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif';

export interface StaticContent {
  site: Site | null;
  anchors: Anchor[];
  floor: string;
  selected: number | null;
  driven_cells: Set<string>; // "x y" of cells of 1 m, while calibrating
}

// 1, 2 or 5 times a power of ten, and at least this wide on the screen.
export function grid_step_m(px_per_m: number, at_least_px: number): number {
  const wanted_m = at_least_px / px_per_m;
  const power = 10 ** Math.floor(Math.log10(wanted_m));
  return power * ([1, 2, 5].find((factor) => factor * power >= wanted_m) ?? 10);
}

// Returns where symbols and labels of the anchors are, so that other labels keep clear of them.
export function draw_static(context: CanvasRenderingContext2D, camera: Camera, colours: Colours, content: StaticContent): Box[] {
  draw_floors(context, camera, colours, content);
  draw_grid(context, camera, colours);
  draw_cells(context, camera, colours, content.driven_cells);
  draw_walls(context, camera, colours, content.site?.walls ?? []);
  const placed = content.anchors.filter((anchor) => anchor.position_m !== null);
  for (const anchor of placed) draw_anchor_ellipse(context, camera, colours, anchor);
  for (const anchor of placed) draw_anchor(context, camera, colours, anchor, anchor.id === content.selected);
  return draw_labels(context, camera, colours, placed, content.selected);
}

function path(context: CanvasRenderingContext2D, camera: Camera, points: number[][]): void {
  points.forEach(([x = 0, y = 0], i) => {
    const [x_px, y_px] = camera.to_px(x, y);
    if (i === 0) context.moveTo(x_px, y_px);
    else context.lineTo(x_px, y_px);
  });
}

function draw_floors(context: CanvasRenderingContext2D, camera: Camera, colours: Colours, { site, floor }: StaticContent): void {
  for (const { name, outline_m } of site?.floors ?? []) {
    if (!outline_m || outline_m.length < 3) continue;
    const is_here = name === null || floor === "" || name === floor;
    context.beginPath();
    path(context, camera, outline_m);
    context.closePath();
    context.fillStyle = colours.floor;
    if (is_here) context.fill();
    context.setLineDash(is_here ? [] : [4, 4]);
    context.strokeStyle = colours.idle;
    context.lineWidth = 1;
    context.stroke();
    context.setLineDash([]);
  }
}

function draw_grid(context: CanvasRenderingContext2D, camera: Camera, colours: Colours): void {
  const step_m = grid_step_m(camera.px_per_m, 48);
  const [left_m, top_m] = camera.to_m(0, 0);
  const [right_m, bottom_m] = camera.to_m(camera.width_px, camera.height_px);
  context.strokeStyle = colours.grid;
  context.lineWidth = 1;
  context.beginPath();
  for (let i = Math.ceil(left_m / step_m); i * step_m <= right_m; i++) {
    const x_px = Math.round(camera.to_px(i * step_m, 0)[0]) + 0.5;
    context.moveTo(x_px, 0);
    context.lineTo(x_px, camera.height_px);
  }
  for (let i = Math.ceil(bottom_m / step_m); i * step_m <= top_m; i++) {
    const y_px = Math.round(camera.to_px(0, i * step_m)[1]) + 0.5;
    context.moveTo(0, y_px);
    context.lineTo(camera.width_px, y_px);
  }
  context.stroke();
}

function draw_cells(context: CanvasRenderingContext2D, camera: Camera, colours: Colours, cells: Set<string>): void {
  context.fillStyle = colours.estimate;
  context.globalAlpha = 0.12;
  for (const cell of cells) {
    const [x = 0, y = 0] = cell.split(" ").map(Number);
    const [x_px, y_px] = camera.to_px(x, y + 1);
    context.fillRect(x_px, y_px, camera.px_per_m, camera.px_per_m);
  }
  context.globalAlpha = 1;
}

function draw_walls(context: CanvasRenderingContext2D, camera: Camera, colours: Colours, walls: number[][]): void {
  context.strokeStyle = colours.wall;
  context.lineWidth = Math.min(5, Math.max(2, 0.12 * camera.px_per_m));
  context.lineCap = "square";
  context.lineJoin = "miter";
  context.beginPath();
  for (const [x0 = 0, y0 = 0, x1 = 0, y1 = 0] of walls) path(context, camera, [[x0, y0], [x1, y1]]);
  context.stroke();
  context.lineCap = "butt";
}

function draw_anchor_ellipse(context: CanvasRenderingContext2D, camera: Camera, colours: Colours, anchor: Anchor): void {
  const [xx = NaN, xy = NaN, , , yy = NaN] = anchor.covariance_m2 ?? [];
  const ellipse = ellipse_95(xx, xy, yy);
  if (!ellipse) return;
  draw_ellipse(context, camera, camera.to_px(anchor.position_m![0]!, anchor.position_m![1]!), ellipse, { colour: colours.anchor, fill: 0.12, line: 0.8, width_px: 1.2 });
}

function draw_anchor(context: CanvasRenderingContext2D, camera: Camera, colours: Colours, anchor: Anchor, is_selected: boolean): void {
  const [x_px, y_px] = camera.to_px(anchor.position_m![0]!, anchor.position_m![1]!);
  if (is_selected) {
    context.beginPath();
    context.arc(x_px, y_px, kAnchor_px + 10, 0, 2 * Math.PI);
    context.strokeStyle = colours.ink;
    context.lineWidth = 2;
    context.stroke();
  }
  if (anchor.coverage < 1) draw_coverage(context, colours, x_px, y_px, anchor.coverage);
  draw_symbol(context, symbol_of(anchor.verdict), colours, x_px, y_px, kAnchor_px);
}

// A ring around the anchor that closes with its coverage.
function draw_coverage(context: CanvasRenderingContext2D, colours: Colours, x_px: number, y_px: number, coverage: number): void {
  context.lineWidth = 3.5;
  context.beginPath();
  context.arc(x_px, y_px, kAnchor_px + 5, 0, 2 * Math.PI);
  context.strokeStyle = colours.rule;
  context.stroke();
  context.beginPath();
  context.arc(x_px, y_px, kAnchor_px + 5, -Math.PI / 2, -Math.PI / 2 + 2 * Math.PI * Math.max(0.02, coverage));
  context.strokeStyle = colours.busy;
  context.stroke();
}

export interface Box {
  left: number;
  top: number;
  right: number;
  bottom: number;
}

export const overlaps = (a: Box, b: Box) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;

// Each label takes the first place around its anchor that no symbol and no other label has.
function draw_labels(context: CanvasRenderingContext2D, camera: Camera, colours: Colours, anchors: Anchor[], selected: number | null): Box[] {
  const at = (anchor: Anchor) => camera.to_px(anchor.position_m![0]!, anchor.position_m![1]!);
  const taken: Box[] = anchors.map((anchor) => {
    const [x, y] = at(anchor);
    return { left: x - kAnchor_px, right: x + kAnchor_px, top: y - kAnchor_px, bottom: y + kAnchor_px };
  });
  context.textBaseline = "middle";
  context.textAlign = "center";
  context.lineJoin = "round";
  for (const anchor of anchors) {
    context.font = `${anchor.id === selected ? 700 : 600} 12px ${kFont}`;
    const label = String(anchor.id);
    const half_px = context.measureText(label).width / 2 + 2;
    const [x, y] = at(anchor);
    const off_px = kAnchor_px + (anchor.id === selected ? 12 : anchor.coverage < 1 ? 8 : 3);
    const places = [
      [x + off_px + half_px, y],
      [x - off_px - half_px, y],
      [x, y - off_px - 7],
      [x, y + off_px + 7],
      [x + off_px + half_px - 2, y - off_px - 4],
      [x + off_px + half_px - 2, y + off_px + 4],
      [x - off_px - half_px + 2, y - off_px - 4],
      [x - off_px - half_px + 2, y + off_px + 4],
    ].map(([cx = 0, cy = 0]) => ({ left: cx - half_px, right: cx + half_px, top: cy - 7, bottom: cy + 7 }));
    const place = places.find((box) => !taken.some((other) => overlaps(box, other))) ?? places[0]!;
    taken.push(place);
    const [cx, cy] = [(place.left + place.right) / 2, (place.top + place.bottom) / 2];
    context.strokeStyle = colours.card;
    context.lineWidth = 3.5;
    context.strokeText(label, cx, cy);
    context.fillStyle = colours.ink;
    context.fillText(label, cx, cy);
  }
  return taken;
}
