import assert from "node:assert/strict";
import test from "node:test";
import { McapWriter } from "@mcap/core";
import { FileProblem, read_recording } from "../src/mcap";
import { anchors_of, pairs_of } from "../src/model";

// Writes protobuf fields as host/convert/proto_writer.hpp does.
function field(number: number, value: number | string | Uint8Array | { integer: number }): Uint8Array {
  const varint = (of: number): number[] => (of < 128 ? [of] : [(of % 128) + 128, ...varint(Math.floor(of / 128))]);
  if (typeof value === "number") {
    const bytes = new Uint8Array(8);
    new DataView(bytes.buffer).setFloat64(0, value, true);
    return Uint8Array.from([...varint(8 * number + 1), ...bytes]);
  }
  if (typeof value === "object" && "integer" in value) return Uint8Array.from([...varint(8 * number), ...varint(value.integer)]);
  const bytes = typeof value === "string" ? new TextEncoder().encode(value) : value;
  return Uint8Array.from([...varint(8 * number + 2), ...varint(bytes.length), ...bytes]);
}
const message = (...fields: Uint8Array[]) => Uint8Array.from(fields.flatMap((of) => [...of]));
const doubles = (values: number[]) => new Uint8Array(Float64Array.from(values).buffer);

interface Options {
  encoding?: string;
  compress?: boolean;
  topics?: Record<string, string>;
}

const kTopics = { "/groma/scene": "foxglove.SceneUpdate", "/groma/ranges": "groma_msgs.Ranges", "/groma/estimate": "groma_msgs.Estimate", "/groma/log": "foxglove.Log", "/groma/input/odometry": "groma_msgs.Odometry" };

async function file_of(messages: { topic: string; t_s: number; data: Uint8Array }[], { encoding = "protobuf", compress = false, topics = kTopics }: Options = {}): Promise<Blob> {
  const parts: Uint8Array[] = [];
  let size = 0;
  const writable = {
    position: () => BigInt(size),
    write: async (bytes: Uint8Array) => {
      parts.push(bytes.slice());
      size += bytes.length;
    },
  };
  // Whether the bytes are really compressed does not matter for a reader that refuses them.
  const writer = new McapWriter({ writable, ...(compress ? { compressChunk: (data: Uint8Array) => ({ compression: "zstd", compressedData: data }) } : {}) });
  await writer.start({ profile: "", library: "test" });
  const channels = new Map<string, number>();
  for (const [topic, name] of Object.entries(topics)) {
    const schemaId = await writer.registerSchema({ name, encoding: "protobuf", data: new Uint8Array() });
    channels.set(topic, await writer.registerChannel({ topic, schemaId, messageEncoding: encoding, metadata: new Map() }));
  }
  for (const { topic, t_s, data } of messages) {
    const time = BigInt(Math.round(t_s * 1e9));
    await writer.addMessage({ channelId: channels.get(topic)!, sequence: 0, logTime: time, publishTime: time, data });
  }
  await writer.end();
  return new Blob(parts as BlobPart[]);
}

const shape = (x: number, y: number, z: number) => field(1, field(1, message(field(1, x), field(2, y), field(3, z))));
const estimate = (x_m: number, state: string, reason = "") =>
  message(field(3, x_m), field(4, 2), field(8, 0.5), field(9, doubles(Array.from({ length: 36 }, (_, i) => i))), field(10, state), field(11, reason));

function drive() {
  const scene = message(
    field(2, message(field(2, "map"), field(3, "anchor 4"), field(6, message(field(1, "covariance_m2"), field(2, "1 0 0 0 4 0 0 0 9"))), field(8, shape(1, 2, 3)), field(13, field(6, "4")))),
    field(2, message(field(2, "map"), field(3, "anchor 12"), field(8, shape(4, 5, 6)), field(13, field(6, "12 weak-z")))),
    field(2, message(field(2, "base_link"), field(3, "robot"), field(9, shape(0.7, 0.2, 1.9)), field(9, shape(-0.7, 0, 1)))),
  );
  const out: { topic: string; t_s: number; data: Uint8Array }[] = [{ topic: "/groma/scene", t_s: 100, data: scene }];
  for (let i = 0; i < 200; i++) {
    const t_s = 100 + i / 20;
    out.push({ topic: "/groma/ranges", t_s, data: field(2, message(field(1, t_s), field(2, { integer: 1 }), field(3, { integer: 300 }), field(4, 7.25))) });
    out.push({ topic: "/groma/input/odometry", t_s, data: message(field(2, 0.8)) });
    out.push({ topic: "/groma/estimate", t_s, data: estimate(i / 20, i < 20 ? "CONVERGING" : "TRACKING") });
  }
  out.push({ topic: "/groma/log", t_s: 101, data: message(field(3, "TRACKING")) });
  return out.sort((a, b) => a.t_s - b.t_s);
}

test("a recording becomes a model with poses, anchors, tags, pairs and log", async () => {
  const { model, begin_s, end_s, has_poses } = await read_recording(await file_of(drive()), () => {});
  assert.equal(begin_s, 100);
  assert.equal(end_s, 109.95);
  assert.equal(has_poses, true);
  const moment = model.moment(5.001);
  assert.ok(Math.abs(moment.pose!.x_m - 5) < 0.11, String(moment.pose!.x_m));
  assert.equal(moment.pose!.yaw_rad, 0.5);
  assert.deepEqual([moment.pose!.xx_m2, moment.pose!.xy_m2, moment.pose!.yy_m2, moment.pose!.yaw_rad2], [0, 1, 7, 35]);
  assert.equal(moment.pose!.vx_mps, 0.8);
  assert.equal(model.moment(0.5).pose!.state, "CONVERGING");
  const [four, twelve] = anchors_of(moment);
  assert.deepEqual([four!.id, four!.verdict, four!.position_m], [4, "ok", [1, 2, 3]]);
  assert.deepEqual(four!.covariance_m2, [1, 0, 0, 0, 4, 0, 0, 0, 9]);
  assert.equal(twelve!.covariance_m2, null);
  assert.deepEqual([twelve!.id, twelve!.verdict, twelve!.position_m], [12, "weak-z", [4, 5, 6]]);
  assert.deepEqual(model.site!.tags, [{ id: 1, lever_arm_m: [0.7, 0.2, 1.9] }, { id: 2, lever_arm_m: [-0.7, 0, 1] }]);
  const [pair] = pairs_of(model.status);
  assert.deepEqual([pair!.tag, pair!.anchor, pair!.ranges, pair!.range_m], [1, 300, 200, 7.25]);
  assert.ok(Math.abs(model.status!.driven_m - 0.8 * 9.95) < 1e-6);
  assert.equal(model.logs.items[0]!.text, "TRACKING");
});

const refused = async (file: Blob, words: RegExp) =>
  assert.rejects(read_recording(file, () => {}), (error: unknown) => error instanceof FileProblem && (assert.match(error.message, words), true));

test("each file that is none of Groma is refused with what to do", async () => {
  await refused(new Blob([]), /empty/);
  await refused(new Blob(["glog and so on"]), /no MCAP file.*groma convert/);
  const whole = await file_of(drive());
  await refused(whole.slice(0, whole.size - 200), /incomplete or damaged/);
  await refused(await file_of(drive(), { encoding: "cdr" }), /ROS 2.*without --ros2/);
  await refused(await file_of(drive(), { compress: true }), /compressed with zstd/);
  await refused(await file_of([{ topic: "/camera", t_s: 1, data: new Uint8Array() }], { topics: { "/camera": "foxglove.RawImage" } }), /no poses or ranges.*\/camera/);
});

test("a damaged message, or a damaged chunk, is named", async () => {
  await refused(await file_of([{ topic: "/groma/estimate", t_s: 1, data: Uint8Array.from([0x52, 0x7f, 1]) }]), /damaged.*torn/);
  const bytes = new Uint8Array(await (await file_of(drive())).arrayBuffer());
  bytes.fill(0xff, 2000, 2400);
  await refused(new Blob([bytes]), /damaged/);
});
