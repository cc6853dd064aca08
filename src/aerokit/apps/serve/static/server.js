// The server: requests with the token, and the stream, which is opened again when it ends.

const PROTOCOL = "aerokit.v1";
const KEPT = "aerokit token";

function takeToken() {
  const found = /(?:^#|&)token=([A-Za-z0-9._~-]+)/.exec(location.hash);
  if (found) {
    sessionStorage.setItem(KEPT, found[1]);
    history.replaceState(null, "", location.pathname); // not to be seen over a shoulder, or copied with the address
  }
  return sessionStorage.getItem(KEPT) || "";
}

let token = takeToken();
window.addEventListener("hashchange", () => { token = takeToken(); });

export const hasToken = () => token !== "";
export function useToken(text) {
  token = text.trim();
  sessionStorage.setItem(KEPT, token);
}

export class Refusal extends Error {
  constructor(problem) {
    super(problem.detail || problem.title || "refused");
    this.problem = problem;
  }
}

export async function ask(method, path, body, headers = {}) {
  const options = { method, headers: { ...headers }, cache: "no-store", credentials: "omit", redirect: "error" };
  if (token) options.headers.Authorization = `Bearer ${token}`;
  if (body !== undefined) {
    options.headers["Content-Type"] = "application/json";
    options.body = JSON.stringify(body);
  }
  const response = await fetch(path, options);
  const answer = await response.json();
  if (!response.ok) throw new Refusal(answer);
  return answer;
}

export const newKey = () =>
  Array.from(crypto.getRandomValues(new Uint8Array(16)), (each) => each.toString(16).padStart(2, "0")).join("");

// told: {message(m), opened(), closed(reason)}
export function openStream(told) {
  let wait = 500;
  function open() {
    const url = new URL("api/stream?rate_hz=5", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    url.hash = "";
    const socket = new WebSocket(url, token ? [PROTOCOL, `bearer.${token}`] : [PROTOCOL]);
    let heardAt = performance.now();
    const watchdog = setInterval(() => { if (performance.now() - heardAt > 6000) socket.close(); }, 1000);
    socket.onopen = () => { wait = 500; told.opened(); };
    socket.onmessage = (event) => { heardAt = performance.now(); told.message(JSON.parse(event.data)); };
    socket.onclose = async () => {
      clearInterval(watchdog);
      told.closed(await whyClosed());
      setTimeout(open, wait);
      wait = Math.min(wait * 1.7, 5000);
    };
  }
  open();
}

async function whyClosed() {
  try {
    await ask("GET", "api/vehicles");
    return "lost";
  } catch (error) {
    return error instanceof Refusal && error.problem.status === 401 ? "unauthorized" : "lost";
  }
}
