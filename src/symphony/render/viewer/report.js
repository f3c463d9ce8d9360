const $ = id => document.getElementById(id);
const columns = JSON.parse($("columns").textContent), runs = JSON.parse($("data").textContent);
const escapeText = text => String(text).replace(/[&<>"]/g, c => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[c]);
let sorted = null, up = false, most = 200;

function cell(run, name) {
  const value = run[name];
  if (name === "segment" && run.link) return `<td><a href="${escapeText(run.link)}">${escapeText(value)}</a></td>`;
  if (name === "what") return `<td class="what">${escapeText(value)}</td>`;
  return `<td class="${typeof value === "number" ? "n" : ""}">${value === null ? "–" : escapeText(value)}</td>`;
}

function show() {
  const words = $("filter").value.toLowerCase();
  let found = runs.filter(run => `${run.segment} ${run.what}`.toLowerCase().includes(words));
  if (sorted) found = found.slice().sort((a, b) => {
    if (a[sorted] === null || b[sorted] === null) return (a[sorted] === null) - (b[sorted] === null);
    return (a[sorted] < b[sorted] ? -1 : a[sorted] > b[sorted] ? 1 : 0) * (up ? 1 : -1);
  });
  $("runs").tHead.innerHTML = "<tr>" + Object.entries(columns).map(([name, text]) => `<th data-name="${name}" class="${name === sorted ? `sorted${up ? " up" : ""}` : ""}">${escapeText(text)}</th>`).join("") + "</tr>";
  $("runs").tBodies[0].innerHTML = found.slice(0, most).map(run => `<tr>${Object.keys(columns).map(name => cell(run, name)).join("")}</tr>`).join("");
  $("count").textContent = `${found.length} of ${runs.length}`;
  $("more").hidden = found.length <= most;
}
$("runs").tHead.onclick = event => {
  const name = event.target.dataset.name;
  if (!name) return;
  up = sorted === name ? !up : false; sorted = name; show();
};
$("filter").oninput = show;
$("more").onclick = () => { most *= 5; show(); };
show();
document.body.dataset.ready = "1";
