// The way to the operator's process and back: questions, what a person says, and the stream of ticks.
import { word } from "./words.js";

const WITHIN_MS = 25000, SILENT_MS = 5000;

export class Refused extends Error {
  constructor(status, text, reasons) {
    super(text);
    this.status = status;
    this.reasons = reasons;
  }

  // Nobody has said whether it was done.
  get unknown() {
    return this.status === 0 || this.status >= 500;
  }
}

let token = null;
export const keepToken = (given) => (token = given);

export async function ask(path, body, within_ms = WITHIN_MS) {
  const options = { cache: "no-store", signal: AbortSignal.timeout(within_ms) };
  if (body !== undefined) {
    Object.assign(options, { method: "POST", body: JSON.stringify(body), headers: { "content-type": "application/json" } });
    if (token) options.headers["x-r2rgate-token"] = token;
  }
  let answer, found;
  try {
    answer = await fetch(path, options);
    found = await answer.text();
  } catch {
    throw new Refused(0, word("net.away"), []);
  }
  found = parsed(found) ?? { text: answer.statusText };
  if (!answer.ok) throw new Refused(answer.status, found.text ?? answer.statusText, found.reasons ?? []);
  return found;
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

// Calls heard(kind, data) for every event, while the page can be seen; `lost` where it may not listen. What comes back
// begins it anew. A stream that is silent for long is taken to be cut.
export function listen(heard, lost) {
  let source = null, heard_ms = 0;
  const end = () => {
    source?.close();
    source = null;
  };
  const begin = () => {
    end();
    if (document.hidden) return;
    const mine = new EventSource("events");
    [source, heard_ms] = [mine, performance.now()];
    for (const kind of ["tick", "away", "anew"]) {
      mine.addEventListener(kind, (event) => {
        if (mine !== source) return;
        heard_ms = performance.now();
        if (kind === "anew") end();
        heard(kind, JSON.parse(event.data));
      });
    }
    mine.addEventListener("error", () => {
      if (mine !== source || mine.readyState !== EventSource.CLOSED) return;
      end();
      lost();
    });
  };
  document.addEventListener("visibilitychange", () => (document.hidden ? end() : begin()));
  setInterval(() => source && performance.now() - heard_ms > SILENT_MS && begin(), 1000);
  begin();
  return begin;
}
