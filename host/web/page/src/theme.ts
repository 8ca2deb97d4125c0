// Light and dark: as the system says, unless chosen here. Canvases need the colours as values.

export interface Colours {
  paper: string;
  card: string;
  ink: string;
  soft: string;
  rule: string;
  grid: string;
  estimate: string;
  wall: string;
  anchor: string;
  good: string;
  warn: string;
  bad: string;
  busy: string;
  idle: string;
  floor: string;
}

const kNames: (keyof Colours)[] = ["paper", "card", "ink", "soft", "rule", "grid", "estimate", "wall", "anchor", "good", "warn", "bad", "busy", "idle", "floor"];
const kChoices = ["auto", "light", "dark"] as const;
type Choice = (typeof kChoices)[number];
const kKey = "groma-theme";

export class Theme {
  colours!: Colours;
  private choice: Choice = "auto";
  private readonly dark = matchMedia("(prefers-color-scheme: dark)");

  constructor(
    private readonly button: HTMLButtonElement,
    private readonly changed: () => void,
  ) {
    const stored = storage()?.getItem(kKey);
    this.choice = kChoices.find((choice) => choice === stored) ?? "auto";
    button.addEventListener("click", () => {
      this.choice = kChoices[(kChoices.indexOf(this.choice) + 1) % kChoices.length]!;
      storage()?.setItem(kKey, this.choice);
      this.apply();
      this.changed();
    });
    this.dark.addEventListener("change", () => {
      this.apply();
      this.changed();
    });
    this.apply();
  }

  private apply(): void {
    const is_dark = this.choice === "dark" || (this.choice === "auto" && this.dark.matches);
    document.documentElement.dataset.theme = is_dark ? "dark" : "light";
    this.button.textContent = `Theme: ${this.choice}`;
    const style = getComputedStyle(document.documentElement);
    this.colours = Object.fromEntries(kNames.map((name) => [name, style.getPropertyValue(`--${name}`).trim()])) as unknown as Colours;
  }
}

// Absent where the browser blocks it.
function storage(): Storage | null {
  try {
    return localStorage;
  } catch {
    return null;
  }
}
