// The banner: the state, what it means, what to do, and what else is wrong.
import { h, set_attribute, set_text } from "./dom";
import type { Notice, Words } from "./states";

export class Banner {
  readonly element: HTMLElement;
  private readonly title = h("h2", { class: "state" });
  private readonly code = h("span", { class: "code" });
  private readonly meaning = h("span", { class: "meaning" });
  private readonly remedy = h("span", { class: "remedy" });
  private readonly notices = h("ul", { class: "notices" });
  private notices_shown = "";

  constructor(private readonly announcement: HTMLElement) {
    const sign = h("span", { class: "sign", "aria-hidden": "true" });
    const text = h("div", { class: "state-text" }, h("div", { class: "state-line" }, this.title, this.code), h("p", {}, this.meaning, " ", this.remedy));
    this.element = h("section", { class: "banner", "aria-label": "State" }, h("div", { class: "headline" }, sign, text), this.notices);
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
          h("li", { "data-tone": tone }, h("strong", {}, title), h("p", {}, text), h("p", { class: "remedy" }, remedy)),
        ),
      );
    }
    // A screen reader speaks it when it changes.
    const spoken = [words.title, words.meaning, words.remedy, ...notices.map(({ title }) => title)].join(". ");
    set_text(this.announcement, spoken);
  }
}
