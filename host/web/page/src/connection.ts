// The WebSocket to gromad: connects again with back-off, and hands over messages in slices, so that a long history does
// not keep the page from drawing.
import type { Message } from "./messages";

export type ConnectionState = "connecting" | "open" | "closed";

const kFirstDelay_s = 0.5;
const kLongestDelay_s = 10;
// gromad sends STATUS each second: a connection that is silent for longer is dead, even if TCP has not noticed.
const kSilence_s = 8;
const kSlice_ms = 6;

export interface Listener {
  message(message: Message, arrived_s: number): void;
  state(state: ConnectionState): void;
}

interface Item {
  text: string;
  arrived_s: number;
}

export class Connection {
  state: ConnectionState = "connecting";
  last_message_s = NaN;
  private socket: WebSocket | null = null;
  private delay_s = kFirstDelay_s;
  private queue: Item[] = [];
  private next = 0;
  private readonly slices = new MessageChannel();
  private watch: ReturnType<typeof setTimeout> | undefined;

  constructor(
    private readonly url: string,
    private readonly listener: Listener,
  ) {
    this.slices.port1.onmessage = () => this.work();
    this.open();
  }

  private open(): void {
    const socket = new WebSocket(this.url);
    this.socket = socket;
    socket.onmessage = (event) => {
      if (this.socket !== socket || typeof event.data !== "string") return;
      if (this.state !== "open") {
        this.delay_s = kFirstDelay_s;
        this.change("open");
      }
      this.last_message_s = performance.now() / 1000;
      this.watch_silence();
      this.queue.push({ text: event.data, arrived_s: this.last_message_s });
      if (this.queue.length === 1) this.slices.port2.postMessage(null);
    };
    socket.onclose = () => {
      if (this.socket === socket) this.lost();
    };
    this.watch_silence();
  }

  private watch_silence(): void {
    clearTimeout(this.watch);
    this.watch = setTimeout(() => this.lost(), kSilence_s * 1000);
  }

  private lost(): void {
    clearTimeout(this.watch);
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    this.change("closed");
    // Different pages do not all come back at the same moment.
    setTimeout(() => this.open(), this.delay_s * (0.75 + Math.random() / 2) * 1000);
    this.delay_s = Math.min(2 * this.delay_s, kLongestDelay_s);
  }

  private change(state: ConnectionState): void {
    this.state = state;
    this.listener.state(state);
  }

  private work(): void {
    const end_ms = performance.now() + kSlice_ms;
    while (this.next < this.queue.length && performance.now() < end_ms) {
      const { text, arrived_s } = this.queue[this.next++]!;
      try {
        this.listener.message(JSON.parse(text) as Message, arrived_s);
      } catch (error) {
        console.error("a message of gromad was left out:", error); // the next ones still count
      }
    }
    if (this.next < this.queue.length) {
      this.slices.port2.postMessage(null);
    } else {
      this.queue = [];
      this.next = 0;
    }
  }
}
