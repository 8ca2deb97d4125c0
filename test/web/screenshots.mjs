// Screenshots of the live page for the documents: node screenshots.mjs FOLDER
import { mkdtempSync, rmSync, statSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { launch, open_page, serve_states } from "./browser.mjs";
import { sleep, start_site, wait_for } from "./site.mjs";

const output = process.argv[2];
const kMost_kb = 150;
const kDesktop = { width: 1400, height: 900 };
const kTablet = { width: 1024, height: 768 };
const kDrive_s = 75; // of the site, so that there are a trail and anchors in each state of the calibration

const folder = mkdtempSync(join(tmpdir(), "groma-web-"));
const browser = await launch();

async function shoot(url, size, scheme, name, prepare) {
  const { page, close } = await open_page(browser, url, size, scheme);
  await wait_for("the history", () => page.evaluate(() => window.groma.model.history === "complete"));
  await sleep(3);
  await prepare?.(page);
  const path = join(output, name);
  await page.screenshot({ path });
  await close();
  const kb = statSync(path).size / 1000;
  console.log(`${path}: ${kb.toFixed(0)} kB`);
  if (kb > kMost_kb) throw new Error(`${path} has more than ${kMost_kb} kB`);
}

const site = await start_site();
try {
  const serve = await serve_states(folder);
  const lost = await serve("--state", "LOST");
  await shoot(lost.url, kTablet, "light", "live_lost.png");
  await lost.stop();
  await sleep(kDrive_s);
  await shoot(site.url, kDesktop, "light", "live_desktop_light.png");
  await shoot(site.url, kTablet, "dark", "live_tablet_dark.png", async (page) => {
    await page.locator("#panel-0 .pick").nth(3).click();
    await sleep(1);
  });
} finally {
  await browser.close();
  await site.stop();
  rmSync(folder, { recursive: true });
}
process.exit();
