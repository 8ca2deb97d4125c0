// Bounded memories of what has been received. Times (at_s) are those of the model's own axis, which never goes back.

export interface Pose {
  at_s: number;
  t_s: number;
  state: string;
  reason: string;
  floor: string;
  x_m: number;
  y_m: number;
  z_m: number;
  yaw_rad: number;
  xx_m2: number;
  xy_m2: number;
  yy_m2: number;
  yaw_rad2: number;
  vx_mps: number;
  vy_mps: number;
  omega_radps: number;
}

// Words as small numbers. A stream has a dozen of them; what is beyond 255 is one word.
class Words {
  private readonly words = [""];
  private readonly numbers = new Map([["", 0]]);

  number_of(word: string): number {
    const known = this.numbers.get(word);
    if (known !== undefined) return known;
    if (this.words.length > 255) return 0;
    this.words.push(word);
    this.numbers.set(word, this.words.length - 1);
    return this.words.length - 1;
  }

  word(number: number): string {
    return this.words[number] ?? "";
  }
}

const kNumbers = ["at_s", "t_s", "x_m", "y_m", "z_m", "yaw_rad", "xx_m2", "xy_m2", "yy_m2", "yaw_rad2", "vx_mps", "vy_mps", "omega_radps"] as const;
const kWords = ["state", "reason", "floor"] as const;
export type PoseNumber = (typeof kNumbers)[number];

// A ring of poses in typed arrays: its size does not depend on what the stream has. A pose has a sequence number, which it
// keeps while the ring moves on: first() to end() - 1.
export class PoseHistory {
  private readonly numbers: Record<PoseNumber, Float64Array>;
  private readonly words: Record<(typeof kWords)[number], Uint8Array>;
  private readonly dictionary = new Words();
  private first_ = 0;
  private end_ = 0;

  constructor(private readonly capacity: number) {
    const columns = (names: readonly string[], make: () => unknown) => Object.fromEntries(names.map((name) => [name, make()]));
    this.numbers = columns(kNumbers, () => new Float64Array(capacity)) as typeof this.numbers;
    this.words = columns(kWords, () => new Uint8Array(capacity)) as typeof this.words;
  }

  first(): number {
    return this.first_;
  }

  end(): number {
    return this.end_;
  }

  clear(): void {
    this.first_ = this.end_;
  }

  push(pose: Pose): void {
    const slot = this.end_ % this.capacity;
    for (const name of kNumbers) this.numbers[name][slot] = pose[name];
    for (const name of kWords) this.words[name][slot] = this.dictionary.number_of(pose[name]);
    this.end_++;
    if (this.end_ - this.first_ > this.capacity) this.first_++;
  }

  drop_before(at_s: number): void {
    while (this.first_ < this.end_ && this.number("at_s", this.first_) < at_s) this.first_++;
  }

  number(name: PoseNumber, sequence: number): number {
    return this.numbers[name][sequence % this.capacity]!;
  }

  state(sequence: number): string {
    return this.dictionary.word(this.words.state[sequence % this.capacity]!);
  }

  get(sequence: number): Pose {
    const slot = sequence % this.capacity;
    const pose = {} as Pose;
    for (const name of kNumbers) pose[name] = this.numbers[name][slot]!;
    for (const name of kWords) pose[name] = this.dictionary.word(this.words[name][slot]!);
    return pose;
  }

  // The sequence number after the last pose that is not later; first() if there is none.
  end_at(at_s: number): number {
    let low = this.first_;
    let high = this.end_;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.number("at_s", middle) <= at_s) low = middle + 1;
      else high = middle;
    }
    return low;
  }
}

// Records by time. The last one that is older than the horizon stays, because it still holds there.
export class History<T extends { at_s: number }> {
  readonly items: T[] = [];

  constructor(private readonly capacity: number) {}

  push(item: T): void {
    this.items.push(item);
    if (this.items.length > this.capacity) this.items.shift();
  }

  clear(): void {
    this.items.length = 0;
  }

  drop_before(at_s: number): void {
    let count = 0;
    while (count + 1 < this.items.length && this.items[count + 1]!.at_s <= at_s) count++;
    if (count > 0) this.items.splice(0, count);
  }

  last(): T | null {
    return this.items[this.items.length - 1] ?? null;
  }

  // Index of the last record that is not later; -1 if there is none.
  index_at(at_s: number): number {
    let low = 0;
    let high = this.items.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.items[middle]!.at_s <= at_s) low = middle + 1;
      else high = middle;
    }
    return low - 1;
  }

  at(at_s: number): T | null {
    return this.items[this.index_at(at_s)] ?? null;
  }
}
