// Symbols of anchors: a shape and a colour for each verdict, in the map, its legend and the tables.
import type { Colours } from "./theme";

type Shape = "circle" | "diamond" | "triangle" | "square" | "cross" | "ring";

export interface AnchorSymbol {
  shape: Shape;
  colour: keyof Colours;
}

const kSymbols: Record<string, AnchorSymbol> = {
  ok: { shape: "circle", colour: "good" },
  "weak-z": { shape: "diamond", colour: "warn" },
  weak: { shape: "triangle", colour: "warn" },
  "never-in-sight": { shape: "square", colour: "bad" },
  moved: { shape: "cross", colour: "bad" },
  "no-data": { shape: "ring", colour: "idle" },
};

export function symbol_of(verdict: string): AnchorSymbol {
  return kSymbols[verdict] ?? { shape: "ring", colour: "idle" };
}

// Around (x, y), with that radius.
function trace(context: CanvasRenderingContext2D, shape: Shape, x: number, y: number, r: number): void {
  context.beginPath();
  switch (shape) {
    case "diamond":
      polygon(context, [[x, y - 1.25 * r], [x + 1.25 * r, y], [x, y + 1.25 * r], [x - 1.25 * r, y]]);
      break;
    case "triangle":
      polygon(context, [[x, y - 1.25 * r], [x + 1.2 * r, y + 0.9 * r], [x - 1.2 * r, y + 0.9 * r]]);
      break;
    case "square":
      polygon(context, [[x - r, y - r], [x + r, y - r], [x + r, y + r], [x - r, y + r]]);
      break;
    case "cross": {
      const [a, b] = [0.4 * r, 1.2 * r];
      polygon(context, [[-a, -b], [a, -b], [a, -a], [b, -a], [b, a], [a, a], [a, b], [-a, b], [-a, a], [-b, a], [-b, -a], [-a, -a]].map(
        ([dx, dy]) => [x + (dx! + dy!) * Math.SQRT1_2, y + (dy! - dx!) * Math.SQRT1_2] as const,
      ));
      break;
    }
    default:
      context.arc(x, y, r, 0, 2 * Math.PI);
  }
}

function polygon(context: CanvasRenderingContext2D, points: readonly (readonly [number, number])[]): void {
  points.forEach(([x, y], i) => (i === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
  context.closePath();
}

export function draw_symbol(context: CanvasRenderingContext2D, symbol: AnchorSymbol, colours: Colours, x: number, y: number, r: number): void {
  trace(context, symbol.shape, x, y, r);
  context.lineWidth = 2;
  if (symbol.shape === "ring") {
    context.fillStyle = colours.card;
    context.strokeStyle = colours[symbol.colour];
  } else {
    context.fillStyle = colours[symbol.colour];
    context.strokeStyle = colours.card;
  }
  context.stroke();
  context.fill();
  if (symbol.shape === "ring") context.stroke();
}
