// The banner: the state, what it means, what to do, and what else is wrong.
import { h, set_attribute, set_text } from "./dom";
import type { Notice, Words } from "./states";

const kNoticesShown = 3;

export class Banner {
  readonly element: HTMLElement;
  // Which moment is shown, if it is not now.
  private readonly moment = h("span", { class: "moment" });
  private readonly back: HTMLButtonElement;
  private readonly title = h("h2", { class: "state" });
  private readonly code = h("span", { class: "code" });
  private readonly meaning = h("span", { class: "meaning" });
  private readonly remedy = h("span", { class: "remedy" });
  private readonly notices = h("ul", { class: "notices" });
  private readonly more: HTMLButtonElement;
  private is_expanded = false;
  private notices_shown = "";

  constructor(
    private readonly announcement: HTMLElement,
    back_to_live: () => void,
  ) {
    this.back = h("button", { type: "button", class: "back", click: back_to_live }, "Back to live");
    this.more = h("button", { type: "button", class: "more", click: () => this.expand(!this.is_expanded) });
    const sign = h("span", { class: "sign", "aria-hidden": "true" });
    const text = h("div", { class: "state-text" }, h("div", { class: "state-line" }, this.title, this.code), h("p", {}, this.meaning, " ", this.remedy));
    this.element = h("section", { class: "banner", "aria-label": "State" }, h("div", { class: "headline" }, sign, text, h("div", { class: "when" }, this.moment, this.back)), this.notices, this.more);
  }

  // The first ones are the most urgent; all of them would leave the map little room.
  private expand(is_expanded: boolean): void {
    this.is_expanded = is_expanded;
    const items = [...this.notices.children] as HTMLElement[];
    items.forEach((item, index) => (item.hidden = !is_expanded && index >= kNoticesShown));
    this.more.hidden = items.length <= kNoticesShown;
    set_text(this.more, is_expanded ? "Show fewer" : `Show ${items.length - kNoticesShown} more`);
    set_attribute(this.more, "aria-expanded", String(is_expanded));
  }

  show_moment(text: string, is_live: boolean): void {
    set_text(this.moment, text);
    this.moment.hidden = text === "";
    this.back.hidden = is_live;
  }

  show(words: Words, code: string, notices: Notice[]): void {
    set_attribute(this.element, "data-tone", words.tone);
    set_text(this.title, words.title);
    set_text(this.code, code);
    set_text(this.meaning, words.meaning);
    set_text(this.remedy, words.remedy);
    const shown = JSON.stringify(notices);
    if (shown !== this.notices_shown) {
      this.notices_shown = shown;
      this.notices.replaceChildren(
        ...notices.map(({ tone, title, text, remedy }) =>
          h("li", { "data-tone": tone }, h("strong", {}, title), h("p", {}, text, " ", h("span", { class: "remedy" }, remedy))),
        ),
      );
      this.expand(this.is_expanded);
    }
    // A screen reader speaks it when it changes.
    const spoken = [`${words.title}.`, words.meaning, words.remedy, ...notices.map(({ title }) => `${title}.`)].filter(Boolean).join(" ");
    set_text(this.announcement, spoken);
  }
}
