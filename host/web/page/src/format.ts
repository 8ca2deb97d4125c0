// Numbers for people. An unknown value is a dash.

export const kUnknown = "–";

export function fixed(value: number, digits: number): string {
  return Number.isFinite(value) ? value.toFixed(digits).replace("-", "−") : kUnknown;
}

export function with_unit(value: number, digits: number, unit: string): string {
  return Number.isFinite(value) ? `${fixed(value, digits)} ${unit}` : kUnknown;
}

export function percent(share: number): string {
  return Number.isFinite(share) ? `${Math.round(share * 100)} %` : kUnknown;
}

export function count(value: number): string {
  return Number.isFinite(value) ? Math.round(value).toString().replace(/\B(?=(\d{3})+$)/g, "\u202f") : kUnknown;
}

// As 0:04, 12:04, 1:02:03.
export function duration(span_s: number): string {
  if (!Number.isFinite(span_s)) return kUnknown;
  const whole = Math.max(0, Math.floor(span_s + 1e-6));
  const two = (value: number) => value.toString().padStart(2, "0");
  const [hours, minutes, seconds] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  return hours > 0 ? `${hours}:${two(minutes)}:${two(seconds)}` : `${minutes}:${two(seconds)}`;
}

// A length in the unit that fits it: 3 mm, 4.2 cm, 1.35 m.
export function length(value_m: number): string {
  if (!Number.isFinite(value_m)) return kUnknown;
  if (value_m < 0.01) return `${fixed(value_m * 1000, 0)} mm`;
  if (value_m < 1) return `${fixed(value_m * 100, 1)} cm`;
  return `${fixed(value_m, 2)} m`;
}

export function degrees(angle_rad: number): string {
  return Number.isFinite(angle_rad) ? `${fixed((angle_rad * 180) / Math.PI, 1)}°` : kUnknown;
}
