// Tables that sort by a click on their heads, numbers as numbers and names in natural order, and pictures that enlarge.
"use strict";

const natural = new Intl.Collator("en", {numeric: true});

function sorted(table, column, down) {
  const body = table.tBodies[0];
  const key = (row) => row.cells[column].textContent.trim();
  const number = (text) => parseFloat(text.replace("\u2212", "-"));
  const rows = [...body.rows];
  const numeric = rows.every((row) => key(row) === "" || key(row) === "\u2013" || !isNaN(number(key(row))));
  const order = (a, b) => {
    const [x, y] = [key(a), key(b)];
    if (!numeric) return natural.compare(x, y);
    return (isNaN(number(x)) ? Infinity : number(x)) - (isNaN(number(y)) ? Infinity : number(y));
  };
  rows.sort((a, b) => (down ? -1 : 1) * order(a, b));
  body.append(...rows);
}

for (const table of document.querySelectorAll("table.sorted")) {
  if (table.tBodies[0].rows.length < 2) continue;
  for (const head of table.tHead.rows[0].cells) {
    if (!head.textContent.trim()) continue;
    const press = document.createElement("button");
    press.type = "button";
    press.append(...head.childNodes);
    head.append(press);
    press.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      sorted(table, head.cellIndex, down);
    });
  }
}

const large = document.createElement("dialog");
large.setAttribute("aria-label", "enlarged picture");
large.addEventListener("click", () => large.close());
document.body.append(large);
for (const press of document.querySelectorAll("button.enlarge")) {
  press.addEventListener("click", () => {
    const image = press.querySelector("img").cloneNode();
    const caption = document.createElement("p");
    caption.textContent = `${image.alt} (Escape or a click closes)`;
    large.replaceChildren(image, caption);
    large.showModal();
  });
}
