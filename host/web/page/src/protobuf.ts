// Reads protobuf messages field by field: the numbers are those of host/convert/schemas.

export type Value = number | Uint8Array;

// Calls `field` for each field of the message: a number for varints and fixed ones, bytes for the others. Throws if the
// bytes end within a field.
export function read_fields(bytes: Uint8Array, field: (number: number, value: Value) => void): void {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  let at = 0;
  const varint = () => {
    let value = 0;
    for (let scale = 1; ; scale *= 128) {
      if (at >= bytes.length || scale > 2 ** 63) throw new RangeError("a protobuf message is torn");
      const byte = bytes[at++]!;
      value += (byte & 127) * scale;
      if (byte < 128) return value;
    }
  };
  while (at < bytes.length) {
    const key = varint();
    const number = Math.floor(key / 8);
    switch (key % 8) {
      case 0:
        field(number, varint());
        break;
      case 1:
        field(number, view.getFloat64(at, true));
        at += 8;
        break;
      case 2: {
        const size = varint();
        if (at + size > bytes.length) throw new RangeError("a protobuf message is torn");
        field(number, bytes.subarray(at, at + size));
        at += size;
        break;
      }
      case 5:
        field(number, view.getFloat32(at, true));
        at += 4;
        break;
      default:
        throw new RangeError("a protobuf message has an unknown field type");
    }
  }
}

// The numbers, by the field's number; `parts` has the bytes of the others, repeated ones in order.
export interface Fields {
  number: (field: number) => number; // 0 if absent, as in proto3
  text: (field: number) => string;
  parts: (field: number) => Fields[];
  doubles: (field: number) => number[]; // a packed list
}

const decoder = new TextDecoder();

export function fields_of(bytes: Uint8Array): Fields {
  const numbers = new Map<number, number>();
  const parts = new Map<number, Uint8Array[]>();
  read_fields(bytes, (number, value) => {
    if (typeof value === "number") numbers.set(number, value);
    else if (parts.has(number)) parts.get(number)!.push(value);
    else parts.set(number, [value]);
  });
  const last = (field: number) => parts.get(field)?.slice(-1)[0];
  return {
    number: (field) => numbers.get(field) ?? 0,
    text: (field) => decoder.decode(last(field) ?? new Uint8Array()),
    parts: (field) => (parts.get(field) ?? []).map(fields_of),
    doubles: (field) => {
      const packed = last(field) ?? new Uint8Array();
      const view = new DataView(packed.buffer, packed.byteOffset, packed.byteLength);
      return Array.from({ length: Math.floor(packed.length / 8) }, (_, i) => view.getFloat64(8 * i, true));
    },
  };
}
