// Uses the controls of the page, and leaves what it saw in the body's data-seen.
const wait = ms => new Promise(done => setTimeout(done, ms));
const press = (key, options = {}) =>
  document.dispatchEvent(new KeyboardEvent("keydown", {key, cancelable: true, ...options}));
const at = () => Number(get("scrub").value);
const titles = () => [...document.querySelectorAll(".pane h2")].map(node => node.textContent);
const middle = number => {  // the mean color of a picture
  const canvas = document.querySelectorAll(".views canvas")[number];
  const bytes = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  return [0, 1, 2].map(c => bytes.filter((_, i) => i % 4 === c).reduce((a, b) => a + b, 0) / bytes.length * 4);
};
(async () => {
  const seen = {};
  await wait(200);
  seen.titles = titles();
  seen.subsets = [...get("subset").options].map(option => option.value);
  seen.beside = [...get("beside").options].map(option => option.textContent);
  seen.views = [...document.querySelector(".views").querySelectorAll("figcaption")].map(node => node.textContent);
  seen.charts = [...document.querySelector(".pane").querySelectorAll(".chart b")].map(node => node.textContent);
  seen.command = document.querySelector("code").textContent;
  seen.below = document.querySelector(".chart").getBoundingClientRect().bottom;
  seen.curves = [...document.querySelectorAll(".chart")[1].querySelectorAll(".key")].map(node => node.textContent);
  seen.first = middle(0);
  press("ArrowRight"); seen.right = at();
  press("ArrowRight", {shiftKey: true}); seen.ten = at();
  press("ArrowLeft"); seen.left = at();
  press("End"); seen.end = at(); seen.last = middle(0);
  press("Home"); seen.home = at();
  get("speed").value = "4";
  press(" ");
  for (let i = 0; i < 40 && !at(); i++) await wait(50);
  press(" ");
  seen.played = at(); await wait(100); seen.paused = at();
  get("scrub").value = 2; get("scrub").dispatchEvent(new Event("input")); seen.scrubbed = get("step").textContent;
  const before = document.querySelectorAll(".chart")[2].querySelectorAll(".key").length;
  const boxes = document.querySelectorAll(".chart")[2].querySelectorAll("input");
  const box = [...boxes].find(one => !one.checked); box.checked = true; box.dispatchEvent(new Event("change"));
  seen.added = document.querySelectorAll(".chart")[2].querySelectorAll(".key").length - before;
  get("subset").value = seen.subsets[1]; get("subset").dispatchEvent(new Event("change"));
  await wait(100);
  seen.changed = titles();
  seen.lastcharts = [...document.querySelector(".pane").querySelectorAll(".chart b")].map(node => node.textContent);
  press("]"); seen.next = titles();
  press("ArrowDown"); seen.episode = titles();
  press("b"); seen.twins = titles();
  press("ArrowDown"); seen.kept = titles();
  seen.problems = problems;
  document.body.dataset.seen = JSON.stringify(seen);
})();
