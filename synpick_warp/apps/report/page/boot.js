// Applies the chosen colour scheme before the first paint; a page from a file may have no storage.
try {
  const theme = localStorage.getItem("synpick-report-theme");
  if (theme === "light" || theme === "dark") document.documentElement.dataset.theme = theme;
} catch (error) { /* The system's scheme holds. */ }
