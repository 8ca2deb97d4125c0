// Serves the built page and plays a site at /live, for work on the page without gromad:
//   npm run build && npm run dev -- [--port 4722] [--state tour|LEARNING|TRACKING|DEGRADED:tag-silent|...] [--history 600] [--silent]
//   npm run dev -- --stream FILE    plays lines of the pose stream instead (of `nc` to gromad), on the synthetic site's map
// --silent: accepts no WebSocket, as while gromad is down.
import { createReadStream } from "node:fs";
import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import { extname, join, normalize } from "node:path";
import { createInterface } from "node:readline";
import { fileURLToPath } from "node:url";
import { parseArgs } from "node:util";
import { WebSocketServer } from "ws";
import { Site } from "./site.mjs";

const { values } = parseArgs({
  options: { port: { type: "string", default: "4722" }, state: { type: "string", default: "tour" }, history: { type: "string", default: "600" }, stream: { type: "string" }, silent: { type: "boolean", default: false } },
});
const built = process.env.GROMA_PAGE_OUT ?? join(fileURLToPath(new URL("..", import.meta.url)), "dist");
const types = { ".html": "text/html; charset=utf-8", ".js": "text/javascript", ".css": "text/css" };

const server = createServer(async (request, response) => {
  const path = normalize(new URL(request.url, "http://localhost").pathname);
  try {
    const content = await readFile(join(built, path === "/" ? "index.html" : path));
    response.writeHead(200, {
      "Content-Type": types[extname(path)] ?? types[".html"],
      "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:",
      "Cache-Control": "no-store",
    });
    response.end(content);
  } catch {
    response.writeHead(404).end();
  }
});

const send = (client, message) => client.readyState === 1 && client.send(typeof message === "string" ? message : JSON.stringify(message));

function play_synthetic(client) {
  const site = new Site({ state: values.state });
  const history_s = Number(values.history);
  const begin_ms = Date.now();
  const history = site.history(0, history_s);
  send(client, site.version());
  send(client, site.site());
  send(client, site.anchors(history_s));
  send(client, { class: "HISTORY", state: "begin", messages: history.length });
  for (const message of history) send(client, message);
  send(client, { class: "HISTORY", state: "end" });
  let tick = 0;
  return setInterval(() => {
    const t_s = history_s + (Date.now() - begin_ms) / 1000;
    const pose = site.pose(t_s);
    if (pose) send(client, pose);
    if (tick++ % 20 !== 0) return;
    send(client, site.status(t_s));
    if (site.learns) send(client, site.calibration(t_s));
  }, 50);
}

async function play_stream(client, file) {
  const site = new Site({ state: "TRACKING" });
  let begin_s = NaN;
  let last_pose_s = -Infinity;
  const begin_ms = Date.now();
  for await (const line of createInterface({ input: createReadStream(file) })) {
    if (client.readyState !== 1) return;
    const message = JSON.parse(line);
    if (message.class === "VERSION") {
      send(client, line);
      send(client, site.site());
      send(client, { class: "HISTORY", state: "begin", messages: 0 });
      send(client, { class: "HISTORY", state: "end" });
      send(client, site.anchors(0));
      continue;
    }
    if (message.class === "POSE") {
      if (message.t_s - last_pose_s < 0.05) continue;
      last_pose_s = message.t_s;
      if (Number.isNaN(begin_s)) begin_s = message.t_s;
      const wait_ms = 1000 * (message.t_s - begin_s) - (Date.now() - begin_ms);
      if (wait_ms > 0) await new Promise((resolve) => setTimeout(resolve, wait_ms));
    }
    send(client, line);
  }
}

if (!values.silent) {
  new WebSocketServer({ server, path: "/live" }).on("connection", (client) => {
    if (values.stream) return void play_stream(client, values.stream);
    const timer = play_synthetic(client);
    client.on("close", () => clearInterval(timer));
  });
}
server.listen(Number(values.port), "127.0.0.1", () => console.log(`http://127.0.0.1:${values.port}/`));
