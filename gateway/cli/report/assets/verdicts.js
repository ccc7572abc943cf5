// Verdicts as the operator's page shows them, in the place of their tables.
(() => {
  const { h, useWords, beforeAfter, margins } = components;
  useWords("en", page.data.words);
  const shown = {
    figures: ({ figures }) => h("div", {}, beforeAfter(figures)),
    findings: ({ findings }) => margins(findings),
    reported: ({ reported }) => margins(reported),
  };
  for (const place of document.querySelectorAll("[data-verdict]")) {
    place.replaceChildren(shown[place.dataset.part](page.data.verdicts[place.dataset.verdict]));
  }
})();
