// The server: requests with the token, and the stream, which is reopened when it ends.

const PROTOCOL = "aerokit.v1";
const STORAGE_KEY = "aerokit token";

function takeToken() {
  const found = /(?:^#|&)token=([A-Za-z0-9._~-]+)/.exec(location.hash);
  if (found) {
    sessionStorage.setItem(STORAGE_KEY, found[1]);
    history.replaceState(null, "", location.pathname); // hide the token from onlookers, and from copies of the address
  }
  return sessionStorage.getItem(STORAGE_KEY) || "";
}

let token = takeToken();
window.addEventListener("hashchange", () => { token = takeToken(); });

export const hasToken = () => token !== "";
export function useToken(text) {
  token = text.trim();
  sessionStorage.setItem(STORAGE_KEY, token);
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

// handlers: {message(m), opened(), closed(reason)}
export function openStream(handlers) {
  let wait = 500;
  function open() {
    const url = new URL("api/stream?rate_hz=5", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    url.hash = "";
    const socket = new WebSocket(url, token ? [PROTOCOL, `bearer.${token}`] : [PROTOCOL]);
    let receivedAt = performance.now();
    const watchdog = setInterval(() => { if (performance.now() - receivedAt > 6000) socket.close(); }, 1000);
    socket.onopen = () => { wait = 500; handlers.opened(); };
    socket.onmessage = (event) => { receivedAt = performance.now(); handlers.message(JSON.parse(event.data)); };
    socket.onclose = async () => {
      clearInterval(watchdog);
      handlers.closed(await whyClosed());
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
