#!/usr/bin/env python3
"""Checks lines of JSON against a schema whose kinds of objects are distinguished by `event`.

    check_json.py SCHEMA < LINES

Stricter than the schema, which permits keys that later versions add: here a key that it does not name is an error. Prints
the kinds that occurred, and what is wrong; the exit code is 1 if anything is. Needs the package jsonschema.
"""

import json
import sys

from jsonschema import Draft202012Validator


def closed(schema):
    """The schema without room for keys that it does not name."""
    if isinstance(schema, list):
        return [closed(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    schema = {key: closed(part) for key, part in schema.items()}
    if isinstance(schema.get("properties"), dict) and "required" in schema:
        schema.setdefault("additionalProperties", False)
    return schema


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        schema = json.load(file)
    Draft202012Validator.check_schema(schema)
    definitions = closed(schema["$defs"])
    validators = {}
    for reference in schema["anyOf"]:
        name = reference["$ref"].rsplit("/", 1)[1]
        event = definitions[name]["properties"]["event"]["const"]
        validator = Draft202012Validator({"$ref": reference["$ref"], "$defs": definitions})
        validators.setdefault(event, []).append(validator)
    wrong, seen = 0, set()
    for line in sys.stdin:
        value = json.loads(line)
        event = value.get("event")
        seen.add(str(event))
        errors = [list(validator.iter_errors(value)) for validator in validators.get(event, [])]
        if any(not found for found in errors):
            continue
        wrong += 1
        print(f"{event!r} is not as in the schema: {line.strip()[:300]}")
        for found in errors or [[]]:
            print("\n".join(f"    {error.json_path}: {error.message[:200]}" for error in found) or "    no such event")
    print("\n".join(f"seen {event}" for event in sorted(seen)))
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
