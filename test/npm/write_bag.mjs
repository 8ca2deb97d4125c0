// Writes a recording of rosbag2 with the packages that others use, from a JSON file:
//   node test/npm/write_bag.mjs mcap|sqlite INPUT.json OUTPUT
// INPUT has topics: [{name, type, definition, messages: [{time_ns, value}]}].
import { createRequire } from "node:module";
import { readFile, writeFile } from "node:fs/promises";

const require = createRequire(import.meta.url);
const { McapWriter } = require("@mcap/core");
const { MessageWriter } = require("@foxglove/rosmsg2-serialization");
const { parse } = require("@foxglove/rosmsg");

const [storage, input, output] = process.argv.slice(2);
const { topics } = JSON.parse(await readFile(input, "utf8"));
for (const topic of topics) topic.writer = new MessageWriter(parse(topic.definition, { ros2: true }));
const messages = topics
  .flatMap((topic, id) => topic.messages.map(({ time_ns, value }) => ({ id, time: BigInt(time_ns), data: topic.writer.writeMessage(value) })))
  .sort((a, b) => (a.time < b.time ? -1 : a.time > b.time ? 1 : 0));

async function writeMcap() {
  const parts = [];
  let size = 0n;
  const writable = {
    write: async (bytes) => {
      parts.push(Buffer.from(bytes));
      size += BigInt(bytes.length);
    },
    position: () => size,
  };
  const writer = new McapWriter({ writable });
  await writer.start({ profile: "ros2", library: "test" });
  const channels = [];
  for (const { name, type, definition } of topics) {
    const schemaId = await writer.registerSchema({ name: type, encoding: "ros2msg", data: new TextEncoder().encode(definition) });
    channels.push(await writer.registerChannel({ schemaId, topic: name, messageEncoding: "cdr", metadata: new Map() }));
  }
  let sequence = 0;
  for (const { id, time, data } of messages)
    await writer.addMessage({ channelId: channels[id], sequence: sequence++, logTime: time, publishTime: time, data });
  await writer.end();
  await writeFile(output, Buffer.concat(parts));
}

// The tables of rosbag2 in Humble, which stores no definitions.
async function writeSqlite() {
  const SQL = await require("sql.js")();
  const database = new SQL.Database();
  database.run("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)");
  database.run("CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL)");
  database.run(
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)",
  );
  database.run("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL)");
  database.run("CREATE INDEX timestamp_idx ON messages (timestamp ASC)");
  topics.forEach(({ name, type }, id) => database.run("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", [id + 1, name, type]));
  database.run("BEGIN");
  const insert = database.prepare("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)");
  for (const { id, time, data } of messages) insert.run([id + 1, time, data]);
  insert.free();
  database.run("COMMIT");
  await writeFile(output, database.export());
}

await (storage === "mcap" ? writeMcap() : writeSqlite());
