// A recording that `groma convert` made (docs/reference/files.md, "MCAP file"), as messages of the live page: so that the
// same model, map and panels show it.
import { McapIndexedReader } from "@mcap/core";
import type { AnchorsMessage, Message, SiteMessage } from "./messages";
import { Model } from "./model";
import { fields_of, type Fields } from "./protobuf";

const kSchemas: Record<string, string> = {
  "/groma/estimate": "groma_msgs.Estimate",
  "/groma/ranges": "groma_msgs.Ranges",
  "/groma/scene": "foxglove.SceneUpdate",
  "/groma/log": "foxglove.Log",
  "/groma/input/odometry": "groma_msgs.Odometry",
};
const kMostPoses = 40_000;
const kMostStatuses = 7200;
const kSlice_ms = 10;
const kMagic = "\x89MCAP0\r\n";

// What is wrong with a file, for the person who opened it.
export class FileProblem extends Error {}

export interface Recording {
  model: Model;
  begin_s: number;
  end_s: number;
  has_poses: boolean;
}

export async function read_recording(file: Blob, progress: (share: number) => void): Promise<Recording> {
  const reader = await open(file);
  const topics = topics_of(reader);
  const statistics = reader.statistics!;
  const [begin_s, end_s] = [Number(statistics.messageStartTime) / 1e9, Number(statistics.messageEndTime) / 1e9];
  const span_s = Math.max(1, end_s - begin_s);
  const model = new Model({
    horizon_s: Infinity,
    poses: kMostPoses,
    // The longest recordings have fewer poses a second.
    pose_interval_s: Math.max(0.1, (1.5 * span_s) / kMostPoses),
    statuses: kMostStatuses + 10,
  });
  // Times of the axis begin with the recording.
  const translator = new Translator(Math.max(1, span_s / kMostStatuses), (message, t_s) => model.take(message, t_s - begin_s));
  let next_pause_ms = performance.now() + kSlice_ms;
  try {
    for await (const message of reader.readMessages({ topics })) {
      const topic = reader.channelsById.get(message.channelId)!.topic;
      const t_s = Number(message.logTime) / 1e9;
      translator.take(topic, t_s, fields_of(message.data));
      if (performance.now() < next_pause_ms) continue;
      progress((t_s - begin_s) / span_s);
      await new Promise((resolve) => setTimeout(resolve));
      next_pause_ms = performance.now() + kSlice_ms;
    }
  } catch (error) {
    if (error instanceof FileProblem) throw error;
    throw new FileProblem(`The file is damaged (${reason_of(error)}). Convert the recording again.`);
  }
  translator.finish();
  return { model, begin_s, end_s, has_poses: topics.includes("/groma/estimate") };
}

async function open(file: Blob): Promise<McapIndexedReader> {
  if (file.size === 0) throw new FileProblem("The file is empty. Convert the recording again.");
  const head = new Uint8Array(await file.slice(0, 8).arrayBuffer());
  if (String.fromCharCode(...head) !== kMagic) {
    throw new FileProblem("The file is no MCAP file. The page reads files that groma convert made; for a drive.glog, run: groma convert drive.glog --calibration calibration.yaml -o drive.mcap");
  }
  const readable = {
    size: async () => BigInt(file.size),
    read: async (offset: bigint, size: bigint) => {
      if (offset + size > BigInt(file.size)) throw new RangeError("it ends within a record");
      return new Uint8Array(await file.slice(Number(offset), Number(offset + size)).arrayBuffer());
    },
  };
  try {
    return await McapIndexedReader.Initialize({ readable });
  } catch (error) {
    throw new FileProblem(`The file is incomplete or damaged (${reason_of(error)}). Convert the recording again.`);
  }
}

// The topics that the page shows. Throws what a person can act on if the file is of another program or for ROS 2.
function topics_of(reader: McapIndexedReader): string[] {
  const channels = [...reader.channelsById.values()];
  const schema_of = (channel: (typeof channels)[number]) => reader.schemasById.get(channel.schemaId)?.name;
  if (channels.some((channel) => channel.topic.startsWith("/groma/") && channel.messageEncoding === "cdr")) {
    throw new FileProblem("The file has messages of ROS 2. Convert the recording without --ros2.");
  }
  const shown = channels.filter((channel) => channel.messageEncoding === "protobuf" && schema_of(channel) === kSchemas[channel.topic]);
  if (!shown.some((channel) => channel.topic === "/groma/estimate" || channel.topic === "/groma/ranges")) {
    const names = channels.slice(0, 4).map((channel) => channel.topic);
    const found = names.length === 0 ? "It has no topics" : `Its topics are ${names.join(", ")}${channels.length > 4 ? " and others" : ""}`;
    throw new FileProblem(`The file has no poses or ranges of Groma. ${found}. Open a file that groma convert made.`);
  }
  const compressed = reader.chunkIndexes.find((chunk) => chunk.compression !== "");
  if (compressed) {
    throw new FileProblem(`The file is compressed with ${compressed.compression}, which this page does not read. Convert the recording again: groma convert does not compress.`);
  }
  return shown.map((channel) => channel.topic);
}

function reason_of(error: unknown): string {
  const text = error instanceof Error ? error.message : String(error);
  return text.replace(/\s*\[library=.*\]$/, "").slice(0, 160);
}

// Messages of the file to those of the live page. What STATUS has, and the file too, is counted here.
class Translator {
  private state = "WAITING_FOR_ODOMETRY";
  private odometry = 0;
  private ranges = 0;
  private driven_m = 0;
  private turned_rad = 0;
  private odometry_s = NaN;
  private twist = { vx_mps: NaN, vy_mps: NaN, omega_radps: NaN };
  private status_s = NaN;
  private last_s = 0;
  private anchors: { id: number; verdict: string }[] = [];
  private readonly pairs = new Map<string, { tag: number; anchor: number; ranges: number; range_m: number; at_s: number }>();

  constructor(
    private readonly status_interval_s: number,
    private readonly put: (message: Message, t_s: number) => void,
  ) {}

  take(topic: string, t_s: number, fields: Fields): void {
    this.last_s = t_s;
    switch (topic) {
      case "/groma/scene":
        this.take_scene(t_s, fields);
        break;
      case "/groma/ranges":
        for (const range of fields.parts(2)) this.take_range(t_s, range);
        break;
      case "/groma/input/odometry":
        this.take_odometry(t_s, fields);
        break;
      case "/groma/estimate":
        this.take_estimate(t_s, fields);
        break;
      case "/groma/log":
        this.put({ class: "LOG", t_s, text: fields.text(3) }, t_s);
        break;
    }
    if (!(t_s - this.status_s < this.status_interval_s)) this.put_status(t_s);
  }

  finish(): void {
    this.put_status(this.last_s);
  }

  private put_status(t_s: number): void {
    this.status_s = t_s;
    const pairs = [...this.pairs.values()].filter((pair) => t_s - pair.at_s <= 5).map(({ tag, anchor, ranges, range_m }) => ({ tag, anchor, ranges, range_m }));
    const { state, odometry, ranges, driven_m, turned_rad, anchors } = this;
    this.put({ class: "STATUS", t_s, state, odometry, ranges, driven_m, turned_rad, anchors, pairs }, t_s);
  }

  private take_range(t_s: number, range: Fields): void {
    this.ranges++;
    const [tag, anchor, range_m] = [range.number(2), range.number(3), range.number(4)];
    const key = `${tag} ${anchor}`;
    const pair = this.pairs.get(key) ?? { tag, anchor, ranges: 0, range_m, at_s: t_s };
    pair.ranges++;
    pair.range_m += 0.2 * (range_m - pair.range_m); // smoothed as in STATUS
    pair.at_s = t_s;
    this.pairs.set(key, pair);
  }

  private take_odometry(t_s: number, fields: Fields): void {
    this.odometry++;
    this.twist = { vx_mps: fields.number(2), vy_mps: fields.number(3), omega_radps: fields.number(4) };
    const { vx_mps, vy_mps, omega_radps } = this.twist;
    const elapsed_s = t_s - this.odometry_s;
    if (elapsed_s > 0 && elapsed_s < 1) {
      this.driven_m += Math.hypot(vx_mps, vy_mps) * elapsed_s;
      this.turned_rad += Math.abs(omega_radps) * elapsed_s;
    }
    this.odometry_s = t_s;
  }

  private take_estimate(t_s: number, fields: Fields): void {
    this.state = fields.text(10);
    const [x_m, y_m, z_m, yaw_rad] = [3, 4, 5, 8].map((field) => fields.number(field)) as [number, number, number, number];
    const covariance = fields.doubles(9);
    this.put({ class: "POSE", t_s, state: this.state, reason: fields.text(11), x_m, y_m, z_m, yaw_rad, covariance, twist: this.twist }, t_s);
  }

  // Anchors are cubes with their verdict in a text, "12 weak", and their covariance among the details; tags are spheres of the robot, in the order of their ids.
  private take_scene(t_s: number, fields: Fields): void {
    const anchors: NonNullable<AnchorsMessage["anchors"]> = [];
    const site: SiteMessage = { class: "SITE", frame: "map", tags: [], walls: [], floors: [] };
    const position_of = (shape: Fields | undefined) => {
      const at = shape?.parts(1)[0]?.parts(1)[0];
      return [1, 2, 3].map((field) => at?.number(field) ?? 0);
    };
    for (const entity of fields.parts(2)) {
      const id = entity.text(3);
      if (id.startsWith("anchor ")) {
        const verdict = entity.parts(13)[0]?.text(6).split(" ")[1] ?? "ok";
        const covariance = entity.parts(6).find((detail) => detail.text(1) === "covariance_m2");
        const covariance_m2 = covariance ? covariance.text(2).split(" ").map(Number) : null;
        anchors.push({ id: Number(id.slice(7)), position_m: position_of(entity.parts(8)[0]), covariance_m2, verdict });
        site.frame = entity.text(2);
      } else if (id === "robot") {
        site.tags = entity.parts(9).map((sphere, index) => ({ id: index + 1, lever_arm_m: position_of(sphere) }));
      }
    }
    this.anchors = anchors.map(({ id, verdict }) => ({ id, verdict: verdict ?? "" }));
    this.put(site, t_s);
    this.put({ class: "ANCHORS", t_s, anchors }, t_s);
  }
}
