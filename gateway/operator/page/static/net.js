// The way to the operator's process and back: questions, what a person says, and the stream of ticks.
import { english } from "./dom.js";
import { word } from "./words.js";

const WITHIN_MS = 25000, SILENT_MS = 5000, AGAIN_MS = 1000;
const asking = new Set(); // questions under way

export class Refused extends Error {
  constructor(status, text, reasons, said = {}) {
    super(text);
    this.status = status;
    this.reasons = reasons;
    this.said = said; // by language, sentences by the English ones
  }

  // Nobody has said whether it was done.
  get unknown() {
    return this.status === 0 || this.status >= 500;
  }
}

let token = null;
export const keepToken = (given) => (token = given);

// What has less time than others is urgent: a browser keeps some six connections to a page, and questions that hang
// are given up for it.
export async function ask(path, body, within_ms = WITHIN_MS) {
  const mine = new AbortController(), timer = setTimeout(() => mine.abort(), within_ms);
  const options = { cache: "no-store", signal: mine.signal };
  if (body === undefined) asking.add(mine);
  else {
    if (within_ms < WITHIN_MS) asking.forEach((one) => one.abort());
    Object.assign(options, { method: "POST", body: JSON.stringify(body), headers: { "content-type": "application/json" } });
    if (token) options.headers["x-r2rgate-token"] = token;
  }
  let answer, found;
  try {
    answer = await fetch(path, options);
    found = await answer.text();
  } catch {
    throw new Refused(0, word("net.away"), []);
  } finally {
    clearTimeout(timer);
    asking.delete(mine);
  }
  found = parsed(found) ?? { text: answer.statusText };
  if (!answer.ok) throw new Refused(answer.status, found.text ?? answer.statusText, found.reasons ?? [], found.said);
  return found;
}

// Asks again while nobody answers, or `is` does not hold of the answer, as long as `place` stands on the page. Null, with
// the reason in `place`: it was refused.
export async function answered(place, path, is = () => true) {
  while (place.isConnected) {
    try {
      const told = await ask(path);
      if (is(told)) return told;
    } catch (error) {
      if (!(error instanceof Refused)) throw error;
      if (!error.unknown) { // an answer; no way to the gateway is none
        place.replaceChildren(english("p", error.message));
        return null;
      }
    }
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
  }
  return null;
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
