// The messages of /live (docs/reference/live.md), as far as the page reads them. A reader takes nothing for granted:
// each key may be absent or null, because older versions of gromad do not have all of them.

export type Optional<T> = T | null | undefined;

export interface PoseMessage {
  class: "POSE";
  t_s: number;
  state: string;
  reason?: Optional<string>;
  x_m: number;
  y_m: number;
  z_m?: Optional<number>;
  yaw_rad: number;
  floor?: Optional<string>;
  covariance?: Optional<Optional<number>[]>;
  twist?: Optional<{ vx_mps?: Optional<number>; vy_mps?: Optional<number>; omega_radps?: Optional<number> }>;
}

export interface NetworkMessage {
  master?: Optional<number>;
  slot?: Optional<number>;
  slots?: Optional<number>;
  superframe_s?: Optional<number>;
  candidates?: Optional<number>;
  answering?: Optional<number>;
  hop?: Optional<number>;
  beacons_missed?: Optional<number>;
}

export interface LinkMessage {
  link?: Optional<string>;
  open?: Optional<boolean>;
  error?: Optional<string>;
  round_trip_s?: Optional<number>;
  frames?: Optional<number>;
  frames_dropped?: Optional<number>;
  bytes_discarded?: Optional<number>;
  ranges?: Optional<number>;
  node?: Optional<{
    id?: Optional<number>;
    role?: Optional<string>;
    network_id?: Optional<number>;
    version?: Optional<string>;
    sync?: Optional<string>;
    radio_error?: Optional<string>;
    network?: Optional<NetworkMessage>;
  }>;
}

export interface PairMessage {
  tag: number;
  anchor: number;
  ranges?: Optional<number>;
  used?: Optional<number>;
  gated?: Optional<number>;
  range_m?: Optional<number>;
  innovation_m?: Optional<number>;
}

export interface FindingMessage {
  cause?: Optional<string>;
  evidence?: Optional<string>;
  remedy?: Optional<string>;
}

export interface StatusMessage {
  class: "STATUS";
  state: string;
  t_s?: Optional<number>;
  odometry?: Optional<number>;
  ranges?: Optional<number>;
  frames_lost?: Optional<number>;
  dropped?: Optional<number>;
  driven_m?: Optional<number>;
  turned_rad?: Optional<number>;
  links?: Optional<LinkMessage[]>;
  robot?: Optional<LinkMessage>;
  robots?: Optional<LinkMessage[]>;
  pose_latency_s?: Optional<{ p50?: Optional<number>; p99?: Optional<number> }>;
  anchors?: Optional<{ id: number; verdict?: Optional<string> }[]>;
  pairs?: Optional<PairMessage[]>;
  diagnosis?: Optional<FindingMessage[]>;
}

export interface CalibrationMessage {
  class: "CALIBRATION";
  verdict?: Optional<string>;
  anchors?: Optional<
    {
      id: number;
      state?: Optional<string>;
      coverage?: Optional<number>;
      verdict?: Optional<string>;
      advice?: Optional<string>;
      ranges_used?: Optional<number>;
      sigma_m?: Optional<number>;
      drive_to_m?: Optional<number[]>;
    }[]
  >;
}

export interface AnchorsMessage {
  class: "ANCHORS";
  t_s?: Optional<number>;
  verdict?: Optional<string>;
  anchors?: Optional<
    {
      id: number;
      position_m?: Optional<number[]>;
      covariance_m2?: Optional<number[]>;
      verdict?: Optional<string>;
      advice?: Optional<string>;
    }[]
  >;
}

export interface SiteMessage {
  class: "SITE";
  frame?: Optional<string>;
  model?: Optional<string>;
  simulated?: Optional<boolean>;
  learns?: Optional<boolean>;
  tags?: Optional<{ id: number; lever_arm_m: number[] }[]>;
  nodes?: Optional<string[]>;
  walls?: Optional<number[][]>;
  floors?: Optional<{ name?: Optional<string>; outline_m?: Optional<number[][]> }[]>;
}

export interface VersionMessage {
  class: "VERSION";
  program?: Optional<string>;
  version?: Optional<string>;
  protocol?: Optional<number>;
}

export interface HistoryMessage {
  class: "HISTORY";
  state: "begin" | "end";
  messages?: Optional<number>;
}

export interface LogMessage {
  class: "LOG";
  t_s?: Optional<number>;
  text: string;
}

export type Message =
  | VersionMessage
  | SiteMessage
  | HistoryMessage
  | AnchorsMessage
  | PoseMessage
  | StatusMessage
  | CalibrationMessage
  | LogMessage;
