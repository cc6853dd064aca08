// Searches a built site with its own search engine: node search_site.mjs SITE QUERY...
// Prints {query: [[address, title], ...]}: the best entry of each page, in the order in which the site shows the pages.
import fs from "node:fs";
import path from "node:path";
import vm from "node:vm";

const [site, ...queries] = process.argv.slice(2);
const workers = path.join(site, "assets/javascripts/workers");
const worker = fs.readdirSync(workers).find(name => name.startsWith("search.") && name.endsWith(".js"));
const index = JSON.parse(fs.readFileSync(path.join(site, "search/search_index.json"), "utf8"));

let listener, answered;
const context = {
  console,
  addEventListener: (_, callback) => { listener = callback; },
  postMessage: message => answered(message),
};
context.self = context;
vm.runInNewContext(fs.readFileSync(path.join(workers, worker), "utf8"), context);

const ask = message => new Promise(resolve => { answered = resolve; listener({ data: message }); });
const SETUP = 0, QUERY = 2;
await ask({ type: SETUP, data: { ...index, options: { suggest: false } } });
const found = {};
for (const query of queries) {
  const { data } = await ask({ type: QUERY, data: query });
  found[query] = data.items.map(([best]) => [best.location, best.title.replace(/<[^>]+>/g, "")]);
}
console.log(JSON.stringify(found));
