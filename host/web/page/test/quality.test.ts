import assert from "node:assert/strict";
import test from "node:test";
import { ellipse_95, gated_share, quality, rate, sigma_m, tag_position_m } from "../src/quality";

const near = (value: number, expected: number) => assert.ok(Math.abs(value - expected) < 1e-9, `${value}, not ${expected}`);

test("the ellipse of a diagonal covariance lies along the axes", () => {
  const wide = ellipse_95(0.04, 0, 0.01)!;
  near(wide.major_m, 0.2 * Math.sqrt(5.991));
  near(wide.minor_m, 0.1 * Math.sqrt(5.991));
  near(wide.angle_rad, 0);
  near(Math.abs(ellipse_95(0.01, 0, 0.04)!.angle_rad), Math.PI / 2);
});

test("a rotated covariance has a rotated ellipse, and the same axes", () => {
  const angle_rad = 0.6;
  const [c, s] = [Math.cos(angle_rad), Math.sin(angle_rad)];
  const ellipse = ellipse_95(0.04 * c * c + 0.01 * s * s, 0.03 * c * s, 0.04 * s * s + 0.01 * c * c)!;
  near(ellipse.angle_rad, angle_rad);
  near(ellipse.major_m, 0.2 * Math.sqrt(5.991));
  near(ellipse.minor_m, 0.1 * Math.sqrt(5.991));
});

test("sigma is that of the worst direction", () => {
  near(sigma_m(0.04, 0, 0.01), 0.2);
  near(sigma_m(0.025, 0.015, 0.025), 0.2);
  assert.equal(ellipse_95(NaN, 0, 0.01), null);
  assert.ok(Number.isNaN(sigma_m(0.04, NaN, 0.01)));
});

test("a pair is as good as the worse of gated share and innovation", () => {
  assert.equal(quality(0.05, 0.02), "good");
  assert.equal(quality(0.2, 0.02), "fair");
  assert.equal(quality(0.05, 0.3), "fair");
  assert.equal(quality(0.5, 0.02), "poor");
  assert.equal(quality(0, 1), "poor");
  assert.equal(quality(NaN, 0.02), "good");
  assert.equal(quality(NaN, NaN), "unknown");
});

test("shares and rates are of the time between two counts", () => {
  near(gated_share({ used: 100, gated: 100 }, { used: 130, gated: 110 }), 0.25);
  near(gated_share(null, { used: 90, gated: 10 }), 0.1);
  assert.ok(Number.isNaN(gated_share({ used: 5, gated: 5 }, { used: 5, gated: 5 })));
  assert.ok(Number.isNaN(gated_share({ used: 50, gated: 5 }, { used: 5, gated: 6 })), "the counters began again");
  near(rate(100, 150, 2), 25);
  assert.ok(Number.isNaN(rate(150, 100, 2)));
});

test("a tag is at its lever arm, rotated by the heading", () => {
  const [x_m, y_m] = tag_position_m({ x_m: 10, y_m: 20, yaw_rad: Math.PI / 2 }, [0.7, 0.2, 1.9]);
  near(x_m, 9.8);
  near(y_m, 20.7);
});
