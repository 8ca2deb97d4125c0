// What each state and each reason means, and what to do: all words of the banner in one table. The meanings are those of
// docs/reference/gromad.md ("The pose stream"), the remedies those of host/doctor/advice.cpp.
import { anchors_of, type Moment } from "./model";

export type Tone = "good" | "busy" | "warning" | "bad" | "idle";

export interface Words {
  tone: Tone;
  title: string;
  meaning: string;
  remedy: string;
}

export const kStates: Record<string, Words> = {
  UNINITIALIZED: {
    tone: "busy",
    title: "Pose unknown",
    meaning: "gromad does not know yet where the robot is.",
    remedy: "Drive some metres: the pose is found from ranges and motion.",
  },
  CONVERGING: {
    tone: "busy",
    title: "Finding the pose",
    meaning: "gromad searches for the pose, or checks a pose that it has just started from.",
    remedy: "Drive some metres, and wait until the ranges agree.",
  },
  TRACKING: {
    tone: "good",
    title: "Tracking",
    meaning: "The pose is valid.",
    remedy: "Nothing to do.",
  },
  DEGRADED: {
    tone: "warning",
    title: "Degraded",
    meaning: "There is a pose, but it has a problem.",
    remedy: "See the reason and the findings.",
  },
  LOST: {
    tone: "bad",
    title: "Lost",
    meaning: "The ranges contradict the pose, and gromad is not yet certain of another one.",
    remedy: "Drive some metres where several anchors are in reach.",
  },
  CALIBRATION_DRIVE: {
    tone: "busy",
    title: "Calibration drive",
    meaning: "gromad records a drive, from which it will calibrate the anchors.",
    remedy: "Drive through the whole site, with pose priors, until the drive is over.",
  },
  CALIBRATING: {
    tone: "busy",
    title: "Calibrating",
    meaning: "gromad computes where the anchors are.",
    remedy: "Wait until the calibration is solved.",
  },
  WAITING_FOR_ODOMETRY: {
    tone: "warning",
    title: "Waiting for odometry",
    meaning: "No odometry has arrived from the robot.",
    remedy: "Check the program that sends the robot's odometry.",
  },
  ODOMETRY_TIMES_WRONG: {
    tone: "bad",
    title: "Odometry times wrong",
    meaning: "Odometry arrives, but its times are wrong, so there is no pose.",
    remedy: "Correct the clock of the computer that sends the odometry.",
  },
};

export const kReasons: Record<string, Omit<Words, "tone">> = {
  "no-ranges": {
    title: "no ranges",
    meaning: "No range was used for 1 s; the pose continues by odometry alone.",
    remedy: "Check that the tags are on and in reach of the anchors.",
  },
  "ranges-disagree": {
    title: "ranges disagree",
    meaning: "Over half of the ranges, by weight, contradict the pose.",
    remedy: "Wait some seconds; if it stays, compare the calibration with the site.",
  },
  "no-odometry": {
    title: "no odometry",
    meaning: "No odometry has arrived for 1 s.",
    remedy: "Check the program that sends the robot's odometry.",
  },
  "tag-silent": {
    title: "a tag is silent",
    meaning: "One tag has given no range for 2 s, while others do.",
    remedy: "Check the power and the cable of the tag that gives no ranges.",
  },
  uncertain: {
    title: "pose uncertain",
    meaning: "The pose's sigma is over 1 m or 0.3 rad.",
    remedy: "Drive on, where more anchors are in reach.",
  },
  "off-surface": {
    title: "off the surface",
    meaning: "The robot is outside the surface of the configuration: its height there is a guess.",
    remedy: "Extend the surface in the configuration to where the robot drives.",
  },
  "map-mismatch": {
    title: "the map does not fit",
    meaning: "Most ranges contradict the calibration at every pose; the pose continues by odometry alone.",
    remedy: "Name the calibration of this site, or calibrate again.",
  },
  "odometry-times": {
    title: "odometry times suspect",
    meaning: "The times of odometry are suspect, or it arrives late.",
    remedy: "Correct the clock of the computer that sends the odometry.",
  },
};

export const kNotConnected: Words = {
  tone: "bad",
  title: "No connection to gromad",
  meaning: "gromad does not answer; the page shows what it last received.",
  remedy: "Check that gromad runs and that its computer is in reach; the page connects again by itself.",
};
export const kConnecting: Words = {
  tone: "idle",
  title: "Connecting",
  meaning: "The page connects to gromad.",
  remedy: "Wait a moment.",
};
export const kNoStatus: Words = {
  tone: "idle",
  title: "No status yet",
  meaning: "gromad is connected, and has not reported its state yet.",
  remedy: "Wait some seconds; if it stays, look into gromad's log.",
};
export const kNoFile: Words = {
  tone: "idle",
  title: "No pose at this time",
  meaning: "The recording has no estimate here.",
  remedy: "Move on in the time line; poses need groma convert with a calibration.",
};
export const kNoLink = {
  title: "No link to the node",
  remedy: "Check the node's power, its cable and the path in the configuration; gromad opens the link again by itself.",
};
export const kNoRobotLink = {
  title: "No link to the robot",
  remedy: "Start the robot's program, or check its address in the configuration; gromad connects again by itself.",
};

export const kVerdicts: Record<string, string> = {
  ok: "ok",
  "weak-z": "height uncertain",
  weak: "weak",
  "never-in-sight": "never in line of sight",
  moved: "moved",
  "no-data": "no data",
};

export function state_words(state: string, reason: string): Words {
  const known = kStates[state] ?? {
    tone: "warning" as const,
    title: state || "Unknown state",
    meaning: "This page does not know the state.",
    remedy: "Open the page of this gromad's own version.",
  };
  if (reason === "") return known;
  const why = kReasons[reason] ?? { title: reason, meaning: known.meaning, remedy: known.remedy };
  return { tone: known.tone, title: `${known.title}: ${why.title}`, meaning: why.meaning, remedy: why.remedy };
}

// A pose has none of these.
const kStatusOnly = new Set(["UNINITIALIZED", "CALIBRATION_DRIVE", "CALIBRATING", "WAITING_FOR_ODOMETRY", "ODOMETRY_TIMES_WRONG"]);

// A pose is newer than the status most of the time, and alone has the reason. Without odometry there are no poses: then
// the status has the state. gromad sends the last pose before a state without one up to 0.05 s late.
export function state_of(moment: Moment): { state: string; reason: string } | null {
  const { pose, status } = moment;
  if (!status) return pose && { state: pose.state, reason: pose.reason };
  if (kStatusOnly.has(status.state) && !(pose && pose.at_s > status.at_s + 0.2)) return { state: status.state, reason: "" };
  if (!pose || status.at_s > pose.at_s + 1) {
    if (status.state !== "DEGRADED") return { state: status.state, reason: "" };
    if (status.odometry_hz === 0) return { state: status.state, reason: "no-odometry" };
    return { state: status.state, reason: pose?.state === "DEGRADED" ? pose.reason : "" };
  }
  return { state: pose.state, reason: pose.reason };
}

export interface Notice {
  tone: Tone;
  title: string;
  text: string;
  remedy: string;
}

// What to mend besides the state: links that are not open, and findings of the diagnosis.
export function notices_of(moment: Moment): Notice[] {
  const out: Notice[] = [];
  const closed = (words: { title: string; remedy: string }, link: { link: string; error: string | null }) =>
    out.push({ tone: "bad", title: words.title, text: link.error ? `${link.link}: ${link.error}.` : `${link.link} is not open.`, remedy: words.remedy });
  for (const link of moment.status?.links ?? []) {
    if (!link.open) closed(kNoLink, link);
    if (link.radio_error !== null) {
      const remedy = "Restart the node; if the error comes again, replace its module.";
      out.push({ tone: "bad", title: `The radio of node ${link.id ?? "?"} failed`, text: link.radio_error, remedy });
    }
  }
  for (const link of moment.status?.robots ?? []) if (!link.open) closed(kNoRobotLink, link);
  for (const anchor of anchors_of(moment)) {
    if (anchor.verdict !== "moved" && anchor.state !== "moved") continue;
    const text = "Its ranges contradict the position that the calibration has.";
    out.push({ tone: "warning", title: `Anchor ${anchor.id} moved`, text, remedy: sentence(anchor.advice || "drive past it to calibrate its new position") });
  }
  out.push(...calibration_notice(moment));
  for (const finding of moment.status?.diagnosis ?? []) {
    const [evidence, remedy] = [sentence(finding.evidence), sentence(finding.remedy)];
    out.push({ tone: "warning", title: finding.cause.replace(/-/g, " "), text: evidence, remedy });
  }
  return out;
}

// While anchors are calibrated, the next thing to do is to drive where the least covered one asks for.
function calibration_notice(moment: Moment): Notice[] {
  const anchors = moment.calibration?.anchors ?? [];
  const open = anchors.filter((anchor) => anchor.coverage < 1).sort((a, b) => a.coverage - b.coverage);
  if (open.length === 0) return [];
  const text = `${anchors.length - open.length} of ${anchors.length} anchors are covered.`;
  const next = open.find((anchor) => anchor.advice !== "");
  return [{ tone: "busy", title: "Calibrating while driving", text, remedy: next ? `Next, for anchor ${next.id}: ${next.advice}.` : "Drive on through the site." }];
}

function sentence(text: string): string {
  return text === "" ? "" : text[0]!.toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".");
}
