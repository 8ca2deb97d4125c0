// Foxglove's own client reads /foxglove, and the layout in examples/foxglove names what it finds.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";
import WebSocket from "ws";
import { kRoot, sleep, wait_for } from "./site.mjs";

const require = createRequire(import.meta.url);
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const require_npm = createRequire(join(kRoot, "test/npm/package.json"));
const protobuf = require_npm("protobufjs");
const descriptor = require_npm("protobufjs/ext/descriptor");

const kTopics = {
  "/tf": "foxglove.FrameTransform",
  "/groma/pose": "foxglove.PoseInFrame",
  "/groma/estimate": "groma_msgs.Estimate",
  "/groma/uncertainty": "foxglove.SceneUpdate",
  "/groma/scene": "foxglove.SceneUpdate",
  "/groma/ranges": "groma_msgs.Ranges",
  "/groma/log": "foxglove.Log",
};

// The message type that a channel's schema defines.
function type_of(channel) {
  const files = descriptor.FileDescriptorSet.decode(Buffer.from(channel.schema, "base64"));
  return protobuf.Root.fromDescriptor(files, { keepCase: true }).resolveAll().lookupType(channel.schemaName);
}

export async function check_foxglove(site, stream, check) {
  await wait_for("a pose", () => stream.last, 30);
  await Promise.all([FoxgloveClient.SUPPORTED_SUBPROTOCOL, "foxglove.sdk.v1"].map((name) => check_protocol(site, stream, check, name)));
}

async function check_protocol(site, stream, check, name) {
  const socket = new WebSocket(`ws://127.0.0.1:${site.port}/foxglove`, [name]);
  const client = new FoxgloveClient({ ws: socket });
  const problems = [];
  let info = null;
  let channels = null;
  let times = 0;
  let since_ms = NaN;
  const received = new Map(); // messages by topic
  const subscriptions = new Map();
  const types = new Map();
  client.on("error", (error) => problems.push(String(error)));
  client.on("status", (status) => problems.push(status.message));
  client.on("serverInfo", (event) => (info = event));
  client.on("advertise", (event) => (channels = event));
  client.on("time", () => times++);
  client.on("message", ({ subscriptionId, timestamp, data }) => {
    const channel = subscriptions.get(subscriptionId);
    const type = types.get(channel.topic);
    const bytes = new Uint8Array(data.buffer, data.byteOffset, data.byteLength);
    const value = type.toObject(type.decode(bytes), { longs: Number, defaults: true, arrays: true });
    received.get(channel.topic).push({ ns: timestamp, after_s: (performance.now() - since_ms) / 1000, value });
  });

  await check(`${name}: server information and channels`, async () => {
    await wait_for("the channels", () => info && channels, 5);
    assert.equal(socket.protocol, name);
    assert.match(info.name, /^gromad /);
    assert.deepEqual(info.capabilities, ["time"]);
    assert.deepEqual(Object.fromEntries(channels.map(({ topic, schemaName }) => [topic, schemaName])), kTopics);
    for (const { encoding, schemaEncoding } of channels) assert.deepEqual([encoding, schemaEncoding], ["protobuf", "protobuf"]);
  });
  await check(`${name}: schemas define their messages`, () => {
    for (const channel of channels) types.set(channel.topic, type_of(channel));
  });
  since_ms = performance.now();
  for (const channel of channels) {
    received.set(channel.topic, []);
    subscriptions.set(client.subscribe(channel.id), channel);
  }
  await check(`${name}: /groma/scene comes at once, with the anchors in use`, async () => {
    const first = await wait_for("/groma/scene", () => received.get("/groma/scene")[0], 10);
    assert.ok(first.after_s < 1, `after ${first.after_s} s`);
    const ids = first.value.entities.map((entity) => entity.id);
    assert.ok(ids.includes("robot"));
    const known = new Set(stream.status.anchors.map(({ id }) => `anchor ${id}`));
    const drawn = ids.filter((id) => id.startsWith("anchor "));
    assert.ok(drawn.length > 0);
    for (const id of drawn) assert.ok(known.has(id) || stream.calibrations.at(-1).anchors.some((anchor) => `anchor ${anchor.id}` === id), id);
  });
  await check(`${name}: poses are those of the pose stream`, async () => {
    await sleep(2);
    const messages = [...received.get("/groma/pose")];
    await sleep(0.3);
    const by_ns = new Map([...stream.poses.values()].map((pose) => [Math.round(1e6 * pose.t_s), pose]));
    let compared = 0;
    for (const { ns, value } of messages) {
      const pose = by_ns.get(Math.round(Number(ns) / 1000));
      assert.ok(pose, `the pose at ${Number(ns) / 1e9} s is not in the pose stream`);
      const { position, orientation } = value.pose;
      assert.equal(value.frame_id, pose.frame);
      assert.deepEqual([position.x, position.y, position.z], [pose.x_m, pose.y_m, pose.z_m]);
      assert.deepEqual([orientation.x, orientation.y, orientation.z, orientation.w], pose.quaternion);
      assert.equal(Number(value.timestamp.seconds) + value.timestamp.nanos / 1e9, Number(ns) / 1e9);
      compared++;
    }
    assert.ok(compared > 15, `${compared} poses in 2 s`);
    for (const { ns, value } of received.get("/groma/estimate").slice(0, 20)) {
      const pose = by_ns.get(Math.round(Number(ns) / 1000));
      assert.deepEqual([value.state, value.reason, value.covariance], [pose.state, pose.reason ?? "", pose.covariance]);
    }
  });
  await check(`${name}: times, transforms, ellipses and ranges come`, async () => {
    for (const topic of ["/tf", "/groma/uncertainty", "/groma/ranges"]) await wait_for(topic, () => received.get(topic).length > 0, 5);
    assert.ok(times > 15);
    assert.equal(received.get("/tf")[0].value.child_frame_id, "base_link");
    assert.ok(received.get("/groma/ranges")[0].value.ranges.length > 0);
  });
  await check(`${name}: a topic that is no longer read does not come`, async () => {
    const [id] = [...subscriptions].find(([, channel]) => channel.topic === "/groma/pose");
    client.unsubscribe(id);
    await sleep(0.3);
    const before = received.get("/groma/pose").length;
    await sleep(0.4);
    assert.equal(received.get("/groma/pose").length, before);
  });
  await check(`${name}: no error`, () => assert.deepEqual(problems, []));
  client.close();
  await new Promise((resolve) => socket.on("close", resolve));
}

export async function check_layout(check) {
  await check("the layout for Foxglove and Lichtblick names topics and fields that exist", () => {
    const layout = JSON.parse(readFileSync(join(kRoot, "examples/foxglove/groma-layout.json"), "utf8"));
    const panels = [];
    const walk = (node) => {
      if (typeof node === "string") return void panels.push(node);
      assert.ok(["row", "column"].includes(node.direction) && node.splitPercentage > 0 && node.splitPercentage < 100);
      walk(node.first);
      walk(node.second);
    };
    walk(layout.layout);
    assert.deepEqual([...panels].sort(), Object.keys(layout.configById).sort());
    assert.deepEqual(panels.map((id) => id.split("!")[0]).sort(), ["3D", "Plot", "Plot", "RosOut"]);
    const { messages } = protobuf_file("host/convert/schemas/groma_msgs.proto");
    for (const [id, config] of Object.entries(layout.configById)) {
      const topics = [...Object.keys(config.topics ?? {}), config.topicToRender, ...(config.paths ?? []).map(({ value }) => value.split(".")[0])].filter(Boolean);
      assert.ok(topics.length > 0, id);
      for (const topic of topics) assert.ok(topic in kTopics, `${topic} of ${id}`);
      for (const { value } of config.paths ?? []) {
        const [topic, field] = value.split(".");
        assert.ok(messages.lookupType(kTopics[topic]).fields[field.replace(/\[\d+\]$/, "")], value);
      }
    }
  });
}

function protobuf_file(path) {
  const root = new protobuf.Root();
  root.addJSON(protobuf.common.get("google/protobuf/timestamp.proto").nested);
  protobuf.parse(readFileSync(join(kRoot, path), "utf8"), root, { keepCase: true });
  return { messages: root };
}
