byId("lead").textContent = stabilityLead(DATA);
byId("hint").textContent = STABILITY_HINT;
byId("cases").append(makeStabilityTable(DATA));
