// The TDMA schedule: a bar of one superframe with its slots, and which tag has which.
import { h, set_text } from "./dom";
import { fixed, kUnknown } from "./format";
import type { Link } from "./model";

const kNotReported = "not reported";

export class Slots {
  readonly element = h("div", { class: "slots" });
  private readonly summary = h("p", { class: "hint" });
  private readonly bar = h("ol", { class: "superframe", "aria-label": "Slots of one superframe" });
  private readonly body = h("tbody");
  private shown = "";

  constructor() {
    const titles = ["Node", "Slot", "Anchors", "Hop", "Missed", "Sync"];
    const table = h("table", {}, h("caption", {}, "What each node reports: its slot, anchors that answer of those it knows, hops to the master, beacons missed"), h("thead", {}, h("tr", {}, ...titles.map((title) => h("th", { scope: "col" }, title)))), this.body);
    this.element.append(this.summary, this.bar, h("div", { class: "table" }, table));
  }

  update(links: Link[]): void {
    const nodes = links.filter((link) => link.id !== null);
    const shown = JSON.stringify(nodes.map(({ id, role, sync, network }) => [id, role, sync, network]));
    if (shown === this.shown) return;
    this.shown = shown;
    const networks = nodes.map((node) => node.network);
    const first = <K extends "slots" | "superframe_s" | "master">(key: K) => networks.find((network) => network?.[key] != null)?.[key] ?? null;
    const [slots, superframe_s, master] = [first("slots"), first("superframe_s"), first("master")];
    set_text(
      this.summary,
      slots === null && superframe_s === null
        ? `Slots: ${kNotReported} by the nodes.`
        : `Superframe of ${superframe_s === null ? kUnknown : fixed(1000 * superframe_s, 2)} ms with ${slots ?? kUnknown} slots; ${master ? `master: anchor ${master}` : "no master"}.`,
    );
    const of_slot = (slot: number) => nodes.filter((node) => node.network?.slot === slot);
    this.bar.hidden = !slots;
    this.bar.replaceChildren(
      ...Array.from({ length: Math.min(64, slots ?? 0) }, (_, slot) => {
        const owners = of_slot(slot);
        const names = owners.map((node) => `tag ${node.id}`).join(", ");
        return h("li", { class: owners.length > 0 ? "taken" : null }, h("span", { class: "number" }, `slot ${slot}`), h("span", {}, names || "free or of another link"));
      }),
    );
    this.body.replaceChildren(
      ...nodes.map((node) => {
        const network = node.network;
        const name = h("th", { scope: "row" }, `${node.role ?? "node"} ${node.id}`);
        const sync = h("td", {}, node.sync ?? kNotReported);
        if (network === null) return h("tr", {}, name, h("td", { colspan: 4 }, kNotReported), sync);
        const value = (of: number | null | undefined) => (of == null ? kUnknown : String(of));
        const anchors = network.answering == null && network.candidates == null ? kUnknown : `${value(network.answering)} of ${value(network.candidates)}`;
        const cells = [network.slot == null ? "none" : String(network.slot), anchors, value(network.hop), value(network.beacons_missed)];
        return h("tr", {}, name, ...cells.map((cell) => h("td", {}, cell)), sync);
      }),
    );
  }
}
