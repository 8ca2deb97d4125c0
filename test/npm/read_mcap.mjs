// Reads an MCAP file with the packages that viewers use, and prints all of it as one JSON object:
//   node test/npm/read_mcap.mjs FILE
// Any fault ends it with an error: a wrong checksum, an index that disagrees with the records, a message that its schema
// does not decode, a Foxglove message that the definitions of @foxglove/schemas decode to other values.
import assert from "node:assert/strict";
import { createRequire } from "node:module";
import { open, readFile } from "node:fs/promises";

const require = createRequire(import.meta.url);
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const { parse: parseRosDefinition } = require("@foxglove/rosmsg");
const foxglove = require("@foxglove/schemas/internal");
const protobuf = require("protobufjs");
const descriptor = require("protobufjs/ext/descriptor");

// Foxglove's own definitions, as one namespace.
function foxgloveDefinitions() {
  const root = new protobuf.Root();
  for (const name of ["timestamp", "duration"]) root.addJSON(protobuf.common.get(`google/protobuf/${name}.proto`).nested);
  const enums = Object.values(foxglove.foxgloveEnumSchemas);
  for (const schema of Object.values(foxglove.foxgloveMessageSchemas)) {
    const own = enums.filter((of) => of.parentSchemaName === schema.name);
    protobuf.parse(foxglove.generateProto(schema, own), root, { keepCase: true });
  }
  root.resolveAll();
  return root;
}

const plain = { longs: String, enums: String, defaults: true, arrays: true };
const official = foxgloveDefinitions();

// Field by field, also for messages that the file does not contain.
function compareWithOfficial(root) {
  const fields = (type) => type.fieldsArray.map((f) => [f.id, f.name, f.resolvedType?.fullName ?? f.type, f.repeated]).sort();
  for (const type of root.lookup("foxglove").nestedArray.filter((of) => of instanceof protobuf.Type)) {
    assert.deepEqual(fields(type), fields(official.lookupType(type.fullName)), type.fullName);
    const enums = (of) => of.nestedArray.filter((one) => one instanceof protobuf.Enum).map((one) => [one.name, { ...one.values }]);
    assert.deepEqual(enums(type), enums(official.lookupType(type.fullName)), type.fullName);
  }
}

function protobufDecoder(schema) {
  const root = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data), { keepCase: true }).resolveAll();
  compareWithOfficial(root);
  const type = root.lookupType(schema.name);
  const reference = schema.name.startsWith("foxglove.") ? official.lookupType(schema.name) : undefined;
  return (data) => {
    const value = type.toObject(type.decode(data), plain);
    if (reference) assert.deepEqual(reference.toObject(reference.decode(data), plain), value, schema.name);
    return value;
  };
}

function ros2Decoder(schema) {
  const text = new TextDecoder().decode(schema.data);
  const reader = new MessageReader(parseRosDefinition(text, { ros2: true }));
  return (data) => reader.readMessage(data);
}

function decoderOf(channel, schema) {
  const pair = `${channel.messageEncoding} ${schema.encoding}`;
  if (pair === "protobuf protobuf") return protobufDecoder(schema);
  if (pair === "cdr ros2msg") return ros2Decoder(schema);
  throw new Error(`${channel.topic}: ${pair} has no decoder`);
}

// All records but messages are counted by type.
async function readStream(path) {
  const reader = new McapStreamReader({ validateCrcs: true });
  reader.append(await readFile(path));
  const counts = {};
  for (let record; (record = reader.nextRecord()); ) counts[record.type] = (counts[record.type] ?? 0) + 1;
  assert.equal(reader.done(), true, "the file has no end");
  return counts;
}

async function readIndexed(path) {
  const file = await open(path);
  const readable = {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, size) => {
      const buffer = new Uint8Array(Number(size));
      const { bytesRead } = await file.read(buffer, 0, Number(size), Number(offset));
      assert.equal(bytesRead, Number(size));
      return buffer;
    },
  };
  const reader = await McapIndexedReader.Initialize({ readable });
  const channels = {};
  const decoders = new Map();
  for (const [id, channel] of reader.channelsById) {
    const schema = reader.schemasById.get(channel.schemaId);
    decoders.set(id, decoderOf(channel, schema));
    channels[channel.topic] = {
      schema: schema.name,
      schema_encoding: schema.encoding,
      message_encoding: channel.messageEncoding,
      metadata: Object.fromEntries(channel.metadata),
      messages: Number(reader.statistics.channelMessageCounts.get(id)),
    };
  }
  const messages = [];
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    messages.push({
      topic: reader.channelsById.get(message.channelId).topic,
      time_ns: String(message.logTime),
      sequence: message.sequence,
      value: decoders.get(message.channelId)(message.data),
    });
  }
  const { header, statistics, chunkIndexes } = reader;
  await file.close();
  return { profile: header.profile, library: header.library, statistics, chunks: chunkIndexes.length, channels, messages };
}

const path = process.argv[2];
const content = { ...(await readIndexed(path)), records: await readStream(path) };
const forJson = (_, value) => {
  if (typeof value === "bigint") return Number(value);
  if (value instanceof Map) return Object.fromEntries(value);
  return ArrayBuffer.isView(value) ? Array.from(value) : value;
};
process.stdout.write(JSON.stringify(content, forJson) + "\n");
