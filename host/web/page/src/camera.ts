// Where the map looks: the middle of the canvas in m, and the scale. Moved by pointers, the wheel and keys.

export class Camera {
  x_m = 0;
  y_m = 0;
  px_per_m = 40;
  width_px = 1;
  height_px = 1;

  to_px(x_m: number, y_m: number): [number, number] {
    return [this.width_px / 2 + (x_m - this.x_m) * this.px_per_m, this.height_px / 2 - (y_m - this.y_m) * this.px_per_m];
  }

  to_m(x_px: number, y_px: number): [number, number] {
    return [this.x_m + (x_px - this.width_px / 2) / this.px_per_m, this.y_m - (y_px - this.height_px / 2) / this.px_per_m];
  }

  pan(dx_px: number, dy_px: number): void {
    this.x_m -= dx_px / this.px_per_m;
    this.y_m += dy_px / this.px_per_m;
  }

  // The place under (x_px, y_px) stays there.
  zoom(factor: number, x_px: number, y_px: number): void {
    const [x_m, y_m] = this.to_m(x_px, y_px);
    this.px_per_m = Math.min(2000, Math.max(0.5, this.px_per_m * factor));
    const [x_after_m, y_after_m] = this.to_m(x_px, y_px);
    this.x_m += x_m - x_after_m;
    this.y_m += y_m - y_after_m;
  }

  fit(bounds: { left: number; right: number; bottom: number; top: number }, margin_px: number): void {
    this.x_m = (bounds.left + bounds.right) / 2;
    this.y_m = (bounds.bottom + bounds.top) / 2;
    const across = Math.max(40, this.width_px - 2 * margin_px) / Math.max(1, bounds.right - bounds.left);
    const up = Math.max(40, this.height_px - 2 * margin_px) / Math.max(1, bounds.top - bounds.bottom);
    this.px_per_m = Math.min(200, across, up);
  }
}

export interface Gestures {
  moved: (is_pan: boolean) => void;
  clicked: (x_px: number, y_px: number) => void;
}

const kClick_px = 5;

export function attach_gestures(canvas: HTMLCanvasElement, camera: Camera, gestures: Gestures): void {
  const pointers = new Map<number, { x: number; y: number }>();
  let travelled_px = 0;
  const place = (event: MouseEvent) => ({ x: event.offsetX, y: event.offsetY });
  // Middle and spread of the pointers that are down.
  const span = () => {
    const [a, b] = [...pointers.values()];
    if (!a) return { x: 0, y: 0, spread: 0 };
    if (!b) return { ...a, spread: 0 };
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, spread: Math.hypot(a.x - b.x, a.y - b.y) };
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button > 0) return;
    canvas.setPointerCapture(event.pointerId);
    if (pointers.size === 0) travelled_px = 0;
    else travelled_px = Infinity; // two fingers are no click
    if (pointers.size < 2) pointers.set(event.pointerId, place(event));
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) return;
    const before = span();
    pointers.set(event.pointerId, place(event));
    const after = span();
    travelled_px += Math.hypot(after.x - before.x, after.y - before.y);
    if (travelled_px < kClick_px) return;
    camera.pan(after.x - before.x, after.y - before.y);
    if (before.spread > 0 && after.spread > 0) camera.zoom(after.spread / before.spread, after.x, after.y);
    gestures.moved(true);
  });
  const up = (event: PointerEvent) => {
    if (!pointers.delete(event.pointerId)) return;
    if (event.type === "pointerup" && travelled_px < kClick_px) gestures.clicked(event.offsetX, event.offsetY);
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      camera.zoom(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.05 : 0.0015)), event.offsetX, event.offsetY);
      gestures.moved(false);
    },
    { passive: false },
  );
}
