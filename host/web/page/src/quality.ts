// Arithmetic of uncertainties and of the quality of a pair of tag and anchor.

// A normal distribution in the plane is within this many squared sigmas with 95 %.
export const kChi2_95 = 5.991;

export interface Ellipse {
  major_m: number; // semi-axes
  minor_m: number;
  angle_rad: number; // of the major axis
}

// Eigenvalues of [[xx, xy], [xy, yy]], the larger first. Rounding may make the smaller one negative.
function eigenvalues(xx: number, xy: number, yy: number): [number, number] {
  const mean = (xx + yy) / 2;
  const radius = Math.hypot((xx - yy) / 2, xy);
  return [Math.max(0, mean + radius), Math.max(0, mean - radius)];
}

export function ellipse_95(xx_m2: number, xy_m2: number, yy_m2: number): Ellipse | null {
  if (!Number.isFinite(xx_m2 + xy_m2 + yy_m2)) return null;
  const [major, minor] = eigenvalues(xx_m2, xy_m2, yy_m2);
  return {
    major_m: Math.sqrt(kChi2_95 * major),
    minor_m: Math.sqrt(kChi2_95 * minor),
    angle_rad: Math.atan2(2 * xy_m2, xx_m2 - yy_m2) / 2,
  };
}

// The position's sigma in its worst direction; NaN: unknown.
export function sigma_m(xx_m2: number, xy_m2: number, yy_m2: number): number {
  return Math.sqrt(eigenvalues(xx_m2, xy_m2, yy_m2)[0]);
}

export type Quality = "good" | "fair" | "poor" | "unknown";

export const kFairGatedShare = 0.2;
export const kPoorGatedShare = 0.5;
export const kFairInnovation_m = 0.3;
export const kPoorInnovation_m = 1.0;

// The worse of both: by how many of its ranges the filter refused, and by how far they are from what it predicted.
export function quality(gated_share: number, innovation_m: number): Quality {
  if (Number.isNaN(gated_share) && Number.isNaN(innovation_m)) return "unknown";
  if (gated_share >= kPoorGatedShare || innovation_m >= kPoorInnovation_m) return "poor";
  if (gated_share >= kFairGatedShare || innovation_m >= kFairInnovation_m) return "fair";
  return "good";
}

// Of the ranges between two counts; NaN: there were none, or the counters began again.
export function gated_share(before: { used: number; gated: number } | null, now: { used: number; gated: number }): number {
  const used = now.used - (before?.used ?? 0);
  const gated = now.gated - (before?.gated ?? 0);
  return used < 0 || gated < 0 || used + gated === 0 ? NaN : gated / (used + gated);
}

// Events a second between two counts; NaN: the counter began again.
export function rate(before: number, now: number, elapsed_s: number): number {
  return now < before || !(elapsed_s > 0) ? NaN : (now - before) / elapsed_s;
}

// Where a tag is in the map. Roll and pitch of a ground robot move it by a few centimetres, which no map shows.
export function tag_position_m(pose: { x_m: number; y_m: number; yaw_rad: number }, lever_arm_m: readonly number[]): [number, number] {
  const [forward_m = 0, left_m = 0] = lever_arm_m;
  const cos = Math.cos(pose.yaw_rad);
  const sin = Math.sin(pose.yaw_rad);
  return [pose.x_m + cos * forward_m - sin * left_m, pose.y_m + sin * forward_m + cos * left_m];
}
