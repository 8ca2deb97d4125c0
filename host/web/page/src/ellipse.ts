// An ellipse of uncertainty on the map.
import type { Camera } from "./camera";
import type { Ellipse } from "./quality";

export interface EllipseStyle {
  colour: string;
  fill: number; // opacity
  line: number; // likewise
  width_px: number;
}

export function draw_ellipse(context: CanvasRenderingContext2D, camera: Camera, [x_px, y_px]: [number, number], ellipse: Ellipse, style: EllipseStyle): void {
  context.beginPath();
  context.ellipse(x_px, y_px, ellipse.major_m * camera.px_per_m, ellipse.minor_m * camera.px_per_m, -ellipse.angle_rad, 0, 2 * Math.PI);
  context.fillStyle = context.strokeStyle = style.colour;
  context.globalAlpha = style.fill;
  context.fill();
  context.globalAlpha = style.line;
  context.lineWidth = style.width_px;
  context.stroke();
  context.globalAlpha = 1;
}
