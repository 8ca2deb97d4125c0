// Bundles the tests, which are TypeScript, and runs them with Node's test runner: npm test
import { spawnSync } from "node:child_process";
import { mkdtempSync, readdirSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const folder = fileURLToPath(new URL(".", import.meta.url));
const output = mkdtempSync(join(tmpdir(), "groma-page-"));
try {
  const names = readdirSync(folder).filter((name) => name.endsWith(".test.ts"));
  await build({ entryPoints: names.map((name) => join(folder, name)), outdir: output, bundle: true, platform: "node", format: "esm", target: "node18", outExtension: { ".js": ".mjs" }, logLevel: "warning" });
  const tests = readdirSync(output).map((name) => join(output, name));
  const { status } = spawnSync(process.execPath, ["--expose-gc", "--test", ...tests], { stdio: "inherit", env: { ...process.env, GROMA_ROOT: join(folder, "../../../..") } });
  process.exitCode = status ?? 1;
} finally {
  rmSync(output, { recursive: true });
}
