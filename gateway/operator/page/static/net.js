// The way to the operator's process and back: questions, what a person says, and the stream of ticks.
import { word } from "./words.js";

export class Refused extends Error {
  constructor(status, text, reasons) {
    super(text);
    this.status = status;
    this.reasons = reasons;
  }
}

let token = null;
export const keepToken = (given) => (token = given);

export async function ask(path, body) {
  const options = { cache: "no-store" };
  if (body !== undefined) {
    Object.assign(options, { method: "POST", body: JSON.stringify(body), headers: { "content-type": "application/json" } });
    if (token) options.headers["x-r2rgate-token"] = token;
  }
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Refused(0, word("net.away"), []);
  }
  const found = await answer.json().catch(() => ({ text: answer.statusText }));
  if (!answer.ok) throw new Refused(answer.status, found.text ?? answer.statusText, found.reasons ?? []);
  return found;
}

// Calls heard(kind, data) for every event; comes back by itself, and calls `lost` where it may not.
export function listen(heard, lost) {
  const source = new EventSource("events");
  for (const kind of ["tick", "away", "logged-out"]) {
    source.addEventListener(kind, (event) => {
      if (kind === "logged-out") source.close();
      heard(kind, JSON.parse(event.data));
    });
  }
  source.addEventListener("error", () => {
    if (source.readyState === EventSource.CLOSED) lost();
  });
  return source;
}
