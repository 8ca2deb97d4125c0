// A simulated site with a gromad that serves its live page, and what that gromad says on the pose stream.
import { spawn } from "node:child_process";
import { existsSync, readFileSync } from "node:fs";
import { connect, createServer } from "node:net";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { fileURLToPath } from "node:url";

export const kRoot = fileURLToPath(new URL("../..", import.meta.url));
export const sleep = (s) => new Promise((resolve) => setTimeout(resolve, 1000 * s));

export function groma() {
  const path = process.env.GROMA ?? join(kRoot, "build/release/bin/groma");
  if (!existsSync(path)) throw new Error(`${path} does not exist: build it, or name another one in GROMA`);
  return path;
}

export function free_port() {
  return new Promise((resolve, reject) => {
    const server = createServer();
    server.on("error", reject);
    server.listen(0, "127.0.0.1", () => {
      const { port } = server.address();
      server.close(() => resolve(port));
    });
  });
}

// Waits until `find` gives something; it may be asynchronous.
export async function wait_for(what, find, timeout_s = 30) {
  const end = Date.now() + 1000 * timeout_s;
  for (;;) {
    const found = await find();
    if (found) return found;
    if (Date.now() > end) throw new Error(`${what} did not come in ${timeout_s} s`);
    await sleep(0.1);
  }
}

// Programs that still run when this one ends, in whatever way.
const running = new Set();
process.on("exit", () => {
  for (const pid of running) kill(pid, "SIGKILL");
});
for (const signal of ["SIGINT", "SIGTERM"]) process.on(signal, () => process.exit(1));

function kill(pid, signal) {
  try {
    process.kill(pid, signal);
  } catch {
    // It has ended.
  }
}

// A program whose output is kept. `log` has both streams.
export class Program {
  log = "";
  exit_code = undefined;

  constructor(command, options, environment = {}) {
    this.child = spawn(command, options, { stdio: ["ignore", "pipe", "pipe"], env: { ...process.env, ...environment } });
    this.pid = this.child.pid;
    running.add(this.pid);
    for (const stream of [this.child.stdout, this.child.stderr]) stream.on("data", (text) => (this.log += text));
    this.ended = new Promise((resolve) => {
      this.child.on("error", (error) => {
        this.log += String(error);
        this.exit_code ??= -1;
        resolve();
      });
      this.child.on("exit", (code, signal) => {
        running.delete(this.pid);
        this.exit_code = code ?? signal;
        resolve();
      });
    });
  }

  signal(name) {
    if (this.exit_code === undefined) kill(this.pid, name);
  }

  async stop() {
    this.signal("SIGCONT");
    this.signal("SIGTERM");
    const timer = setTimeout(() => this.signal("SIGKILL"), 10_000);
    await this.ended;
    clearTimeout(timer);
  }

  // The first group of a line of the log.
  async says(pattern, timeout_s = 30) {
    const found = await wait_for(`"${pattern.source}"`, () => this.log.match(pattern) ?? (this.exit_code === undefined ? null : "ended"), timeout_s).catch((error) => {
      throw new Error(`${error.message}; the log:\n${this.log}`);
    });
    if (found === "ended") throw new Error(`${this.child.spawnfile} has ended with ${this.exit_code}:\n${this.log}`);
    return found[1];
  }
}

export class Site extends Program {
  constructor(port, seed) {
    super(groma(), ["demo", "--live", "--port", String(port), "--seed", String(seed)]);
    this.port = port;
    this.url = `http://127.0.0.1:${port}/`;
  }

  async start() {
    this.stream_port = Number(await this.says(/pose stream on 127\.0\.0\.1 port (\d+)/));
    this.folder = (await this.says(/--config (\S+)\/gromad\.yaml/));
    await this.says(/(live page: http:\S+)\n[^]*live page: http/);
    return this;
  }

  calibration() {
    return read_calibration(readFileSync(join(this.folder, "calibration.yaml"), "utf8"));
  }
}

export async function start_site({ seed = 1, port } = {}) {
  return new Site(port ?? (await free_port()), seed).start();
}

// Id, verdict and position of each anchor in a calibration file.
export function read_calibration(yaml) {
  const anchors = new Map();
  for (const part of yaml.split(/^  - id: /m).slice(1)) {
    const position = part.match(/^ {4}position_m: \[(.*)\]$/m);
    anchors.set(Number.parseInt(part, 10), {
      verdict: part.match(/^ {4}verdict: (\S+)$/m)[1],
      position_m: position ? position[1].split(",").map(Number) : null,
    });
  }
  return anchors;
}

// The lines of the pose stream since it was opened.
export class PoseStream {
  poses = new Map(); // by t_s
  statuses = new Map(); // by t_s; those before odometry have none
  calibrations = [];
  first_s = Infinity; // t_s of the first pose
  last = null;
  status = null;

  constructor(port) {
    this.socket = connect(port, "127.0.0.1");
    this.socket.on("error", () => {});
    createInterface({ input: this.socket }).on("line", (line) => this.take(JSON.parse(line)));
  }

  take(message) {
    if (message.class === "POSE") {
      this.poses.set(message.t_s, message);
      this.first_s = Math.min(this.first_s, message.t_s);
      this.last = message;
    } else if (message.class === "STATUS") {
      this.status = message;
      if (message.t_s !== null) this.statuses.set(message.t_s, message);
    } else if (message.class === "CALIBRATION") {
      this.calibrations.push(message);
    }
  }

  close() {
    this.socket.destroy();
  }
}
