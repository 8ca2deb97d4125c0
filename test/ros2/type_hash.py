"""The type hash (RIHS01, REP-2016) of a message's definition: type_hash.py pkg/msg/Name < DEFINITION

DEFINITION: the fields in the syntax of .msg files, then those of each contained type after a line of "=" and a line
"MSG: pkg/Name". The hash is that of a description of all types in JSON, as rosidl_generator_type_description has it.
"""
import hashlib
import json
import re
import sys

IDS = {"int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8, "uint64": 9, "float32": 10,
       "float64": 11, "bool": 15, "byte": 16, "string": 17}
BOUNDED_STRING = 21
NESTED = 1
ARRAY, SEQUENCE = 48, 144


def long_name(name):
    package, short = name.split("/")
    return f"{package}/msg/{short}"


def field_of(line):
    kind, name = line.split()
    base, bound, brackets = re.fullmatch(r"([\w/]+)(?:<=(\d+))?(\[\d*\])?", kind).groups()
    if base in IDS:
        number, nested = (BOUNDED_STRING if bound else IDS[base]), ""
    else:
        number, nested = NESTED, long_name(base)
    size = int(brackets[1:-1] or 0) if brackets else 0
    number += 0 if not brackets else ARRAY if size else SEQUENCE
    return {"name": name, "type": {"type_id": number, "capacity": size, "string_capacity": int(bound or 0), "nested_type_name": nested}}


def main():
    root, *others = re.split(r"=+\nMSG: ", sys.stdin.read())
    texts = {sys.argv[1]: root}
    for other in others:
        name, text = other.split("\n", 1)
        texts[long_name(name.strip())] = text
    types = {name: {"type_name": name, "fields": [field_of(line) for line in text.splitlines() if line.strip()]} for name, text in texts.items()}
    described = {"type_description": types[sys.argv[1]],
                 "referenced_type_descriptions": [types[name] for name in sorted(types) if name != sys.argv[1]]}
    print("RIHS01_" + hashlib.sha256(json.dumps(described).encode()).hexdigest())


main()
