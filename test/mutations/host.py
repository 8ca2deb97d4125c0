"""Mutations of the host's estimators; see scripts/mutations."""

QUICK = ["map watch: a wrong map is never named"]

# name, source, text, its replacement
MUTATIONS = [
    ("map watch: a wrong map is never named", "host/filter/map_watch.cpp", "doubtful_ranges_ >= kWrongAfterRanges", "false"),
]
