// A canvas that keeps a drawing which reaches beyond the visible part of the map: as long as the map only moves within it,
// a frame copies it and draws nothing again.
import { Camera } from "./camera";

const kMargin = 0.25; // of the visible width and height, at each side

export class Layer {
  readonly context: CanvasRenderingContext2D;
  readonly camera: Camera;
  private readonly canvas = document.createElement("canvas");
  private key = "";

  constructor() {
    this.context = this.canvas.getContext("2d")!;
    this.camera = new Camera();
  }

  // Whether the drawing is still right for this view. `key` names all else that it depends on.
  is_valid(view: Camera, ratio: number, key: string): boolean {
    const slack_x_px = (this.camera.width_px - view.width_px) / 2;
    const slack_y_px = (this.camera.height_px - view.height_px) / 2;
    return (
      this.key === `${ratio} ${view.width_px} ${view.height_px} ${key}` &&
      this.camera.px_per_m === view.px_per_m &&
      Math.abs(view.x_m - this.camera.x_m) * view.px_per_m <= slack_x_px &&
      Math.abs(view.y_m - this.camera.y_m) * view.px_per_m <= slack_y_px
    );
  }

  // Empties it for the view; its own camera then says where things are.
  begin(view: Camera, ratio: number, key: string): void {
    this.key = `${ratio} ${view.width_px} ${view.height_px} ${key}`;
    this.camera.x_m = view.x_m;
    this.camera.y_m = view.y_m;
    this.camera.px_per_m = view.px_per_m;
    this.camera.width_px = Math.round(view.width_px * (1 + 2 * kMargin));
    this.camera.height_px = Math.round(view.height_px * (1 + 2 * kMargin));
    const width = Math.round(this.camera.width_px * ratio);
    const height = Math.round(this.camera.height_px * ratio);
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    this.context.setTransform(1, 0, 0, 1, 0, 0);
    this.context.clearRect(0, 0, width, height);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  copy_to(context: CanvasRenderingContext2D, view: Camera, ratio: number): void {
    const [x_px, y_px] = this.camera.to_px(view.x_m, view.y_m);
    // Whole device pixels: a copy between them would blur.
    const left = Math.round((view.width_px / 2 - x_px) * ratio);
    const top = Math.round((view.height_px / 2 - y_px) * ratio);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(this.canvas, left, top);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }
}
