for (const table of document.querySelectorAll(".results")) {
  const body = table.tBodies[0];
  const heads = [...table.tHead.rows[0].cells];
  const number = (row, i) => parseFloat(row.cells[i].dataset.value ?? row.cells[i].textContent);
  heads.forEach((head, i) => head.querySelector("button").addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") !== "descending";
    heads.forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const isText = head.classList.contains("name");
    const rows = [...body.rows].sort((a, b) => {
      if (isText) {
        const order = a.cells[i].textContent.localeCompare(b.cells[i].textContent);
        return down ? -order : order;
      }
      const [x, y] = [number(a, i), number(b, i)];
      if (isNaN(x) || isNaN(y)) return isNaN(x) - isNaN(y); // no value: always last
      return down ? y - x : x - y;
    });
    body.append(...rows);
  }));
}
