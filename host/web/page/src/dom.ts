// A few helpers in place of a framework.

type Child = Node | string | null;
type Attributes = Record<string, string | number | boolean | null | ((event: Event) => void)>;

export function h<K extends keyof HTMLElementTagNameMap>(tag: K, attributes: Attributes = {}, ...children: Child[]): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name, value);
    else if (value !== null && value !== false) element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.filter((child): child is Node | string => child !== null));
  return element;
}

// Only what changed is written: each write costs a layout, and screen readers read it.
export function set_text(node: Element, text: string): void {
  if (node.textContent !== text) node.textContent = text;
}

export function set_attribute(node: Element, name: string, value: string | null): void {
  if (node.getAttribute(name) === value) return;
  if (value === null) node.removeAttribute(name);
  else node.setAttribute(name, value);
}

export interface Column<Row> {
  title: string;
  hint?: string;
  text: (row: Row) => string;
  order?: (row: Row) => number | string; // sortable by it
  words?: boolean; // aligned to the left, may wrap
  tone?: (row: Row) => string; // class of the cell
  mark?: (row: Row) => string; // class of a symbol before the text
}

// A table whose rows have keys. It writes only cells that changed.
export class DataTable<Row> {
  readonly element: HTMLElement;
  private readonly body = h("tbody");
  private readonly headers: HTMLElement[] = [];
  private readonly rows = new Map<string, { element: HTMLTableRowElement; cells: HTMLElement[]; note: HTMLTableRowElement | null }>();
  private readonly empty: HTMLElement;
  private data: Row[] = [];
  private sorted_by = -1;
  private direction = 1;
  private order_on_screen = "";

  constructor(
    caption: string,
    private readonly columns: Column<Row>[],
    private readonly key: (row: Row) => string,
    empty: string,
    private readonly pick?: { label: (row: Row) => string; select: (row: Row) => void; is_selected: (row: Row) => boolean },
    private readonly note?: (row: Row) => string, // a line of its own below the row; empty: none
  ) {
    const header = h("tr");
    columns.forEach((column, index) => {
      const cell = h("th", { scope: "col", class: column.words ? "words" : null, title: column.hint ?? null });
      if (column.order) cell.append(h("button", { type: "button", class: "sort", click: () => this.sort(index) }, column.title));
      else cell.append(column.title);
      this.headers.push(cell);
      header.append(cell);
    });
    this.empty = h("p", { class: "empty" }, empty);
    const table = h("table", {}, h("caption", {}, caption), h("thead", {}, header), this.body);
    this.element = h("div", { class: "table", tabindex: 0, role: "region", "aria-label": caption }, table, this.empty);
  }

  update(data: Row[]): void {
    this.data = data;
    this.empty.hidden = data.length > 0;
    const seen = new Set<string>();
    for (const row of data) {
      const key = this.key(row);
      seen.add(key);
      const shown = this.rows.get(key) ?? this.add(key);
      this.columns.forEach((column, index) => {
        const cell = shown.cells[index]!;
        set_text(cell.lastElementChild ?? cell, column.text(row));
        if (column.tone) set_attribute(cell, "class", [column.words ? "words" : "", column.tone(row)].join(" ").trim() || null);
        if (column.mark) set_attribute(cell.firstElementChild!, "class", `mark ${column.mark(row)}`);
      });
      if (shown.note) {
        const note = this.note!(row);
        set_text(shown.note.firstElementChild!, note);
        shown.note.hidden = note === "";
        set_attribute(shown.note, "class", `note${this.pick?.is_selected(row) ? " selected" : ""}`);
      }
      if (this.pick) {
        set_attribute(shown.element, "class", this.pick.is_selected(row) ? "selected" : null);
        set_attribute(shown.cells[0]!.lastElementChild!, "aria-pressed", String(this.pick.is_selected(row)));
        set_attribute(shown.cells[0]!.lastElementChild!, "aria-label", this.pick.label(row));
      }
    }
    for (const [key, { element, note }] of this.rows) {
      if (seen.has(key)) continue;
      element.remove();
      note?.remove();
      this.rows.delete(key);
    }
    this.arrange();
  }

  private add(key: string) {
    const cells: HTMLElement[] = this.columns.map((column, index) => {
      const cell = h(index === 0 ? "th" : "td", { class: column.words ? "words" : null, scope: index === 0 ? "row" : null });
      if (column.mark) cell.append(h("span", { "aria-hidden": "true" }));
      if (index === 0 && this.pick) {
        const choose = () => {
          const row = this.data.find((of) => this.key(of) === key);
          if (row) this.pick!.select(row);
        };
        cell.append(h("button", { type: "button", class: "pick", click: choose }));
      } else if (column.mark) {
        cell.append(h("span"));
      }
      return cell;
    });
    const note = this.note ? h("tr", { class: "note" }, h("td", { colspan: this.columns.length })) : null;
    const added = { element: h("tr", {}, ...cells), cells, note };
    this.rows.set(key, added);
    return added;
  }

  private sort(index: number): void {
    this.direction = this.sorted_by === index ? -this.direction : 1;
    this.sorted_by = index;
    this.headers.forEach((header, i) =>
      set_attribute(header, "aria-sort", i === index ? (this.direction > 0 ? "ascending" : "descending") : null),
    );
    this.arrange();
  }

  private arrange(): void {
    const order = this.columns[this.sorted_by]?.order;
    const rows = order ? [...this.data].sort((a, b) => this.direction * compare(order(a), order(b))) : this.data;
    const keys = rows.map(this.key);
    const wanted = keys.join("\n");
    if (wanted === this.order_on_screen) return;
    this.order_on_screen = wanted;
    // Moving a row would take the focus from its button.
    const focused = document.activeElement instanceof HTMLElement && this.body.contains(document.activeElement) ? document.activeElement : null;
    for (const key of keys) {
      const { element, note } = this.rows.get(key)!;
      this.body.append(element, ...(note ? [note] : []));
    }
    focused?.focus({ preventScroll: true });
  }
}

// Unknown numbers come last in ascending order.
function compare(a: number | string, b: number | string): number {
  if (typeof a === "string" || typeof b === "string") return String(a).localeCompare(String(b), "en", { numeric: true });
  if (Number.isNaN(a) || Number.isNaN(b)) return Number(Number.isNaN(a)) - Number(Number.isNaN(b));
  return a - b;
}

// Tabs per WAI-ARIA: arrow keys choose, Home and End go to the first and the last.
export function tabs(label: string, entries: { name: string; content: HTMLElement }[], changed: (index: number) => void) {
  const bar = h("div", { role: "tablist", "aria-label": label });
  const buttons = entries.map(({ name, content }, index) => {
    const id = `tab-${index}`;
    content.id = `panel-${index}`;
    content.setAttribute("role", "tabpanel");
    content.setAttribute("aria-labelledby", id);
    const button = h("button", { type: "button", role: "tab", id, "aria-controls": content.id, click: () => select(index) }, name);
    bar.append(button);
    return button;
  });
  const select = (selected: number) => {
    entries.forEach(({ content }, index) => {
      buttons[index]!.setAttribute("aria-selected", String(index === selected));
      buttons[index]!.tabIndex = index === selected ? 0 : -1;
      content.hidden = index !== selected;
    });
    changed(selected);
  };
  bar.addEventListener("keydown", (event) => {
    const at = buttons.indexOf(event.target as HTMLButtonElement);
    const next = { ArrowLeft: at - 1, ArrowRight: at + 1, Home: 0, End: buttons.length - 1 }[event.key];
    if (next === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    const index = (next + buttons.length) % buttons.length;
    select(index);
    buttons[index]!.focus();
  });
  select(0);
  return { element: h("div", { class: "tabs" }, bar, ...entries.map(({ content }) => content)), select };
}
