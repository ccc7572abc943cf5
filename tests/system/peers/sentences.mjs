// Says sentences as the page does: node sentences.mjs FOLDER_OF_ITS_MODULES, words and texts as JSON on standard input.
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const folder = `${pathToFileURL(process.argv[2])}/`;
const { useWords } = await import(new URL("formats.js", folder));
const { sentence } = await import(new URL("sentences.js", folder));
const { words, texts } = JSON.parse(readFileSync(0, "utf8"));
useWords("de", words);
console.log(JSON.stringify(texts.map((text) => sentence(text))));
